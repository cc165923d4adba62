"""Check that the code uses the field's terms for what the field has a term for.

python tests/check_words.py            prints each place that uses another word, and fails if there is one

`EXCEPTIONS` names the files in which a listed word has its ordinary meaning, such as `floor` for rounding down.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("edgegrad", "csrc")

# A word that only this project used, and the term that a reader searches for.
TERMS = {
    "lamp lamps Lamp Lamps MetLamp share_lamps": "light, emitter, EmitterHit, apply_mis",
    "through_": "throughput",
    "fours fours_for_one Companion Companions": "antithetic set",
    "pane panes": "alpha-blended or transparent face",
    "cut_out cut_outs": "alpha mask, alpha-tested face",
    "rim rims Rim Rims": "alpha edge, lens boundary",
    "unseen_shadow unseen_shadows UnseenShadows": "indirect shadow boundary",
    "bounce_lines surface_borders": "secondary edge",
    "Witness Glance Waiting": "visibility query, early-out test, pending sample",
    "ChunkGrad Destination": "thread-local gradients, gradient sink",
    "Way Ways Journal Falls promise tell Tell": "optimiser state, replay log, convergence monitor, predicted decrease, report",
    "looks Looks": "importance map, appearance",
    "beside Beside": "next to, auxiliary channels, parallel, margin",
    "room_for image_room gradient_room": "memory estimate",
    "is_straight straight_image": "undistorted",
    "spoilt dialects": "malformed, format variants",
    "floor floors storeys house houses": "lower bound, layer, package",
    "mirrored_lines upside_down ask_pilots": "specular line, row order, draw pilots",
    "alike ALIKE hopeless Hopeless HOPELESS": "ambiguous, equal, unlikely",
    "FOLLOWED UNCOVERED": "what the number is",
}
# Words in their ordinary meaning, and the files: `floor` rounds down; files lie `beside` another; a picture `looks` like one.
EXCEPTIONS = {
    "floor": """
        csrc/boundary/curve.h csrc/boundary/discontinuity_finder.h csrc/camera/sub_cameras.cpp
        csrc/camera/wide_fisheye.cpp csrc/estimator/view.h csrc/film/film.h csrc/film/importance.h
        csrc/interior/pixel_mask.h csrc/primary/coincident_segments.h csrc/primary/crease_control.cpp
        csrc/raster/rasterize.cpp csrc/raster/sample_texture.cpp csrc/raster/texels.h csrc/scene/topology.cpp
        csrc/secondary/alpha_edges.h csrc/secondary/lune.h csrc/shading/lit/environment.h csrc/texture/texture.cpp
        csrc/texture/texture.h edgegrad/bop/depth.py edgegrad/bop/refine.py edgegrad/files/curve.py
        edgegrad/files/formats/off.py edgegrad/files/formats/ply_elements.py edgegrad/fit/plots.py
        edgegrad/fit/pose/photo/match.py edgegrad/light/near_field.py
        edgegrad/points/blend.py edgegrad/points/discontinuous_pixels.py edgegrad/points/hits.py edgegrad/points/pyramid.py
        edgegrad/points/discontinuity_terms.py edgegrad/points/discontinuities.py edgegrad/raster/exact.py edgegrad/render.py
        edgegrad/scene/environment.py edgegrad/scene/texel_edges.py edgegrad/scene/textures.py edgegrad/track/surface.py
        """,
    "looks": """
        edgegrad/camera/convention_warnings.py
        """,
    "beside": """
        edgegrad/files/formats/context.py edgegrad/files/formats/gltf_material.py edgegrad/files/formats/gltf_write.py
        edgegrad/files/formats/obj.py edgegrad/files/formats/threemf.py
        """,
}


def words() -> dict[str, str]:
    """Return each listed word with the terms for it."""
    return {word: terms for group, terms in TERMS.items() for word in group.split()}


def allowed(path: str, word: str) -> bool:
    """Return True if a word has its ordinary meaning in a file."""
    return path in EXCEPTIONS.get(word, "").split()


def violations(root: Path = ROOT) -> list[str]:
    """Return a line for each listed word."""
    known = words()
    listed = re.compile(rf"(?<![A-Za-z0-9])(?:{'|'.join(known)})(?![A-Za-z0-9])")
    found = []
    for folder in FOLDERS:
        for path in sorted(p for p in (root / folder).rglob("*") if p.suffix in (".py", ".h", ".cpp")):
            name = path.relative_to(root).as_posix()
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                found += [
                    f"{name}:{number}: {match[0]}: write {known[match[0]]}"
                    for match in listed.finditer(line)
                    if not allowed(name, match[0])
                ]
    return found


if __name__ == "__main__":
    lines = violations()
    print("\n".join(lines) or "The code uses the field's terms.")
    sys.exit(bool(lines))
