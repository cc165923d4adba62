"""plan(): the work of a render, and what it leaves out, before it runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .camera.camera import Camera
from .kernel import memory as memory
from .kernel.counts import COUNTS, table
from .kernel.derivatives import moves
from .kernel.flat import Flat
from .kernel.operators import HitBuffers, backward_kernel, image_memory, pass_size
from .kernel.request import DISCONTINUITY_SLOTS, MOVING, SLOTS, Request, WantedTerms, label, make_request, required
from .library import core
from .light.bounces import check_bounces
from .light.radiance import Lighting
from .light.sampling import how_drawn
from .light.unused_options import warn_of_unused
from .points.records import CURVE_BYTES, SURFACE_BYTES, has_intersections, with_attributes
from .points.shadows import ShadowLight
from .points.surfaces import every_face
from .sampling import RenderOptions, check_options, check_sampling, without_shading
from .scene.lights import Light
from .scene.mesh import Mesh
from .scene.mesh_light import MeshLight
from .scene.scene import Scene, as_scene
from .shader import POINTS_AT_ONCE

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True)
class Term:
    """One part of a render and its backward pass."""

    on: bool
    why: str
    samples: int = 0  # rays that it casts
    bytes: int = 0  # of memory that it takes, estimated


# What noise costs: csrc/estimator/default_samples.h.
_NOISE = "4 × spp halve the noise; see eg.noise()"


class Plan(Mapping[str, Term]):
    """The terms of a render and its backward pass, by name: `plan["boundary"].on`. Prints as a table."""

    def __init__(self, terms: Mapping[str, Term]) -> None:
        self._terms = {
            name: term if term.on else replace(term, samples=0, bytes=0)  # what is off takes nothing
            for name, term in terms.items()
        }

    def __getitem__(self, name: str) -> Term:
        try:
            return self._terms[name]
        except KeyError:
            raise KeyError(f"term: expected one of {', '.join(self._terms)}, got {name!r}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._terms)

    def __len__(self) -> int:
        return len(self._terms)

    @property
    def samples(self) -> int:
        """Return the number of rays in all."""
        return sum(term.samples for term in self.values())

    @property
    def bytes(self) -> int:
        """Return the estimated peak memory above the user's own tensors, the image and all gradients included."""
        return sum(term.bytes for term in self.values())

    def __str__(self) -> str:
        rows = [
            (name, "on" if term.on else "off", _count(term.samples), memory.size(term.bytes), term.why)
            for name, term in self.items()
        ]
        gradient = any(self[name].on for name in ("interior", "boundary"))
        total = ("in all", "", _count(self.samples), memory.size(self.bytes), _NOISE if gradient else "")
        return table([("term", "", "samples", "memory", "why"), *rows, total], "<<>><")

    __repr__ = __str__


def plan(
    scene: Scene | Mesh, camera: Camera, spp: int = 16, seed: int | None = 0, **options: Unpack[RenderOptions]
) -> Plan:
    """Describe what a render and its backward pass will do: which terms are on, why, their samples and memory.

    Samples of the gradient are counted for a loss that is nowhere zero and an image that sees every face: where the adjoint is
    zero none are taken, and fewer on faces that no sample of the image hits. Nothing is rendered; the ray structure and the
    edges are built, and render() then finds them. It raises what render() raises.

    Parameters
    ----------
    scene, camera, spp, seed
        As of render(); but the seed is 0 by default, so that a plan does not change what torch's generator draws next.
    **options
        Other arguments of render().

    Returns
    -------
    Plan
        Mapping from the name of a term to a Term; prints as a table.

    Examples
    --------
    >>> import edgegrad as eg
    >>> plan = eg.plan(eg.shapes.box(), eg.Camera.look_at((0, 0, 4), (0, 0, 0), size=(64, 64)))
    >>> plan["image"].samples
    65536
    """
    check_options("plan", options)
    scene = as_scene(scene)
    shader, sampling = options.get("shader"), check_sampling(options.get("sampling"))
    lighting = Lighting.from_options(options.get("shadows", True), options.get("bounces", 1), sampling)
    request = make_request(scene, camera, spp, seed, **without_shading(options))
    warn_of_unused(scene, shader is not None, lighting, sampling)
    if shader is not None:
        return Plan(_shaded_terms(scene, request, sampling.creases))
    if scene.is_shaded:
        if lighting.bounces > 1:
            check_bounces(scene, camera, request)
        return Plan(_lit_terms(scene, request, sampling.creases, lighting))
    wanted = required(request)
    return Plan({**_image_terms(scene, request, bool(wanted)), **_gradient_terms(request, wanted)})


def _shaded_terms(
    scene: Scene, request: Request, creases: object, lit: Scene | None = None, indirect: bool = False
) -> dict[str, Term]:
    """Return the terms with a shader, of which nothing is asked before it runs: neither what it needs nor at which edges it may
    jump."""
    attributes = every_face(len(request.scene.faces)) if creases is True else None
    request = request._replace(scene=with_attributes(request.scene, attributes))
    moving = [name for name in required(request) if name in MOVING]
    # It is not known either whether a tensor of the shader's own requires a gradient.
    wanted = [*moving, "colors"] if torch.is_grad_enabled() else []
    terms = {**_image_terms(scene, request, bool(wanted)), **_gradient_terms(request, wanted, lit, indirect)}
    rows = CURVE_BYTES * terms["boundary"].samples + SURFACE_BYTES * terms["interior"].samples
    terms["textures"] = Term(False, "left to the shader")
    terms["shader"] = Term(
        True, f"asked for at most {POINTS_AT_ONCE:,} points at a time; what it keeps of them is not counted here"
    )
    terms["samples"] = Term(rows > 0, "handed to the shader" if rows else "no gradients", bytes=rows)
    terms["interior"] = replace(
        terms["interior"], why="of what the shader uses" + (" and what moves" if moving else "")
    )
    if creases == "auto" and terms["boundary"].on:
        terms["creases"] = Term(False, "where what the shader asks for jumps; not counted here")
    if lit is None and not terms["discontinuities"].on:
        terms["discontinuities"] = Term(False, "where the shader declares some; not counted here")
    for name in ("colors", "uvs", "texels", "vertex_attributes", "face_attributes"):
        terms.pop(f"{label(name)} gradient", None)
    return terms


def _lit_terms(scene: Scene, request: Request, creases: object, lighting: Lighting) -> dict[str, Term]:
    """Return the terms with materials and lights, which are shaded at points of surfaces and curves, as by a shader."""
    terms = _shaded_terms(scene, request, creases, scene, lighting.bounces > 1)
    lights = sum(1 if light.punctual else lighting.samples for light in scene.casting)
    where = "lit" if scene.is_lit else "seen, with mipmaps"
    terms["textures"] = Term(False, f"looked up where they are {where}")
    del terms["shader"]
    inside = sum(lighting.in_gradient(scene, light) for light in scene.casting)
    more = (
        f"; for the gradient inside faces {inside}, in antithetic sets of four whose opposite signs cancel, and up to "
        f"{core.MOST_SETS_FOR_ONE // core.SETS_FOR_ONE} times as many where faces are seen from aside"
        if inside > lights
        else ""
    )
    terms["lights"] = Term(
        lights > 0,
        f"{lights} points of lights for each point{how_drawn(scene)}{more}; at most {POINTS_AT_ONCE:,} points at a time",
    )
    why = (
        f"{inside} rays for each point of the gradient inside faces, {lights} for others and for each face in a pixel"
        if inside > lights
        else f"{lights} rays for each point of the gradient, and for each face in a pixel"
        if lighting.shadows
        else "shadows=False"
    )
    rays = inside * terms["interior"].samples + lights * terms["boundary"].samples
    terms["shadows"] = Term(lights > 0 and lighting.shadows, why if lights else "no lights", samples=rays)
    slides = request.gradient.visibility and any(name in MOVING for name in required(request))
    interior, boundary = terms["interior"].samples, terms["boundary"].samples
    terms["bounces"] = _bounces(scene, interior + boundary, 4 * interior if slides else 0, lighting)
    terms["shadow boundaries"] = _shadow_boundaries(scene, request, lighting)
    terms["indirect shadow boundaries"] = _indirect_shadow_boundaries(scene, request, lighting)
    terms["secondary edges"] = _secondary_edges(scene, request, lighting)
    terms["surface edges"] = _surface_edges(scene, request, lighting)
    terms["texel edges of lights"] = _texel_edges_of_lights(scene, lighting)
    return terms


def _bounces(scene: Scene, points: int, near_field: int, lighting: Lighting) -> Term:
    """Return the term of bounces, by points of the gradient and by the places at which the near-field term compares light."""
    if lighting.bounces == 1:
        return Term(False, "bounces=1: light is scattered once on its way")
    shadows = len(scene.casting) if lighting.shadows else 0
    return Term(
        True,
        f"a path for each point of the gradient, and two for each ray of the image; {1 + shadows} rays for each of at most "
        f"{lighting.bounces - 1} further points"
        + (
            "; where what is seen slides on its face, four more for the near-field term of each point"
            if near_field
            else ""
        ),
        samples=(lighting.bounces - 1) * (1 + shadows) * (points + near_field),
    )


def _texel_edges_of_lights(scene: Scene, lighting: Lighting) -> Term:
    emitters = [light for light in scene.casting if isinstance(light, MeshLight) and light.has_texel_edges]
    moving = sum(moves(light.coordinates) for light in emitters)
    if not moving:
        return Term(False, "nothing that moves them" if emitters else "no emission is that of the nearest texel")
    count = moving * lighting.samples
    return Term(True, f"{count} point{'s' * (count > 1)} of their texel edges for each point of the interior")


def _lights_with_moving_shadows(
    scene: Scene, request: Request, lighting: Lighting, names: Collection[str]
) -> tuple[list[Light], str]:
    """Return the lights whose shadow boundaries move, as they do with slots of these names; else why there are none."""
    if not scene.casting or not lighting.shadows:
        return [], "shadows=False" if scene.casting else "no lights"
    if not request.gradient.visibility:
        return [], "visibility=False"
    moving = any(name in names for name in required(request))
    return [light for light in scene.casting if moving or ShadowLight.moves(light)], ""


def _shadow_boundaries(scene: Scene, request: Request, lighting: Lighting) -> Term:
    lights, why = _lights_with_moving_shadows(
        scene, request, lighting, DISCONTINUITY_SLOTS if _has_alpha(scene) else MOVING
    )
    if not lights:
        return Term(False, why or "nothing that casts, receives or gives light moves, nor the camera")
    many = sum(not light.punctual for light in lights)
    samples = request.cameras * many * _most_shadow_samples(request)
    each = core.SHADOW_SAMPLES_A_PIXEL * core.sample_growth(request.image.spp)
    why = f"of {len(lights)} light{'s' * (len(lights) > 1)}: {each:g} samples a pixel of boundary"
    why += ", not counted here" + "; of those with an extent by the rays of the image" * (many > 0)
    return Term(True, why, samples=samples, bytes=samples * CURVE_BYTES)


def _indirect_shadow_boundaries(scene: Scene, request: Request, lighting: Lighting) -> Term:
    if lighting.bounces == 1:
        return Term(False, "bounces=1: no surface lights another")
    # How boundaries lie on surfaces does not depend on the camera.
    names = ("verts", *(("uvs", "alphas") if _has_alpha(scene) else ()))
    lights, why = _lights_with_moving_shadows(scene, request, lighting, names)
    if not lights:
        return Term(False, why or "nothing that casts, receives or gives light moves")
    each = request.gradient.edge_samples
    samples = request.cameras * len(lights) * (each if each >= 0 else _most_shadow_samples(request))
    why = (
        f"of {len(lights)} light{'s' * (len(lights) > 1)}, on surfaces that light others: a ray of the light for each sample, "
        f"and one to go on and one to the camera for each of {lighting.bounces - 1} further bounces"
    )
    return Term(True, why, samples=samples, bytes=samples * CURVE_BYTES)


def _secondary_edges(scene: Scene, request: Request, lighting: Lighting) -> Term:
    if why := _why_no_secondary_edges(request, lighting):
        return Term(False, why)
    moving, cut = required(request), _moving_alpha_edges(scene, request)
    if not cut and not any(name in MOVING for name in moving):
        return Term(False, "neither surfaces nor the camera move")
    # The camera alone moves only edges that it sees.
    kinds = lighting.bounces - 1 if cut or "verts" in moving else 1
    samples = request.cameras * kinds * _most_secondary_samples(request)
    past = "edges and alpha edges" if _has_alpha(scene) else "edges"
    why = f"what surfaces see of one another: lines past {past}, each two rays, one to the camera and a path at its other end"
    if kinds > 1:
        why += f"; as many whose light goes on to the camera after each of {kinds - 1} further bounces"
    return Term(True, why, samples=samples, bytes=samples * CURVE_BYTES)


def _surface_edges(scene: Scene, request: Request, lighting: Lighting) -> Term:
    if why := _why_no_secondary_edges(request, lighting):
        return Term(False, why)
    crossings = "verts" in required(request) and has_intersections(request.scene)
    cut = _moving_alpha_edges(scene, request)
    if not (crossings or cut):
        return Term(
            False, "no faces that move pass through each other" + ", no alpha edges move on theirs" * _has_alpha(scene)
        )
    kinds = lighting.bounces - 1
    samples = request.cameras * kinds * max(_most_secondary_samples(request) // 4, 256)
    where = " and ".join(["where faces pass through each other"] * crossings + ["at alpha edges"] * cut)
    why = f"light that surfaces send next to curves {where}: up to 8 rays for each place, each with a path and one to the camera"
    return Term(True, why, samples=samples, bytes=8 * samples * CURVE_BYTES)


def _why_no_secondary_edges(request: Request, lighting: Lighting) -> str:
    if lighting.bounces == 1:
        return "bounces=1: no surface lights another"
    return "" if request.gradient.visibility else "visibility=False"


def _moving_alpha_edges(scene: Scene, request: Request) -> bool:
    return _has_alpha(scene) and any(name in ("uvs", "alphas") for name in required(request))


def _most_secondary_samples(request: Request) -> int:
    each, size = request.gradient.edge_samples, (request.camera.width, request.camera.height)
    return each if each >= 0 else core.default_secondary_samples(*size, request.image.spp)


def _has_alpha(scene: Scene) -> bool:
    return any(mesh.alpha is not None for mesh in scene.meshes)


def _most_shadow_samples(request: Request) -> int:
    return core.default_secondary_samples(request.camera.width, request.camera.height, request.image.spp)


def _image_terms(scene: Scene, request: Request, any_gradient: bool) -> dict[str, Term]:
    camera, B, spp = request.camera, request.cameras, request.image.spp
    needs = core.image_bytes(pass_size(request), B)
    copied = _bytes_of_copies(scene, request.scene)
    cameras = "" if B == 1 else f", {B} cameras"
    textures, alpha_masks = len(request.scene.textures), len(request.scene.alpha_masks)
    return {
        "scene": Term(
            copied > 0,
            "copied end to end, in the kernel's number types" if copied else "read where it is",
            bytes=copied,
        ),
        "ray structure": Term(True, "built once, and again when vertices moved", bytes=needs["ray structure"]),
        "image": Term(True, f"{spp} samples a pixel{cameras}", B * camera.height * camera.width * spp, needs["image"]),
        # Their memory is the user's own, or counted with the scene.
        "textures": Term(textures > 0, f"{textures} to look up" if textures else "no mesh has one"),
        "alpha masks": Term(
            alpha_masks > 0, "rays pass through where alpha is below its cutoff" if alpha_masks else "no mesh has alpha"
        ),
        "kept for backward": Term(
            any_gradient,
            "coverage, depth, and which faces were hit" if any_gradient else "nothing requires a gradient",
            bytes=sum(needs[name] for name in ("coverage", "depth", "faces hit", "faces seen")),
        ),
    }


def _gradient_terms(
    request: Request, wanted: Collection[str], lit: Scene | None = None, indirect: bool = False
) -> dict[str, Term]:
    flat, camera, B = request.scene, request.camera, request.cameras
    work = WantedTerms.from_request(request, wanted)
    moves = any(name in wanted for name in MOVING)

    # The kernel counts them itself. It is asked whatever is wanted, for it also checks what render() leaves to it.
    with image_memory(request):
        ones = flat.colors.new_ones((B, camera.height, camera.width, request.channels))
    hits = HitBuffers(
        ones[..., 0].contiguous(),
        ones.new_full(ones.shape[:-1], math.inf, dtype=torch.float32),
        flat.faces.new_zeros((*ones.shape[:-1], 2), dtype=torch.int32),
        flat.faces.new_ones((B, len(flat.faces)), dtype=torch.uint8),
    )
    _, profiles = backward_kernel(ones, hits, request, wanted, dry=True, lit=lit, indirect=indirect)
    counts = {name: int(sum(profile[name] for profile in profiles)) for name in COUNTS}
    surface, edge, silhouettes, creases, intersections, lens_boundary = (
        counts[name]
        for name in ("surface_samples", "edge_samples", "silhouettes", "creases", "intersections", "lens_boundary")
    )
    needs = core.gradient_bytes(
        pass_size(request), motion=work.motion, boundary=work.boundary, discontinuities=work.discontinuities, wanted=list(wanted),
        surface_samples=surface, edge_samples=edge, curves=silhouettes + creases,
        intersections=intersections, discontinuity_lines=counts["discontinuity_lines"],
    )  # fmt: skip

    needs = {**needs, "view": needs.get("view", 0) + ones.nbytes}

    def term(on: float, off: str, why: str, none: str, *parts: str, samples: int = 0) -> Term:
        """Return a term that is on where something is counted; else `off`, or `none`, says why not."""
        return Term(on > 0, off or (why if on else none), samples, sum(needs.get(part, 0) for part in parts))

    # Why the terms are off, "" where nothing keeps them from running.
    still = "" if moves else "neither verts nor the camera require a gradient"
    no_boundary = still or ("" if request.gradient.visibility else "visibility=False")
    no_lens_boundary = "" if {"K", "distortion"} & set(wanted) else "neither K nor distortion requires a gradient"
    no_interior = ""
    if not (work.motion or work.appearance):
        no_interior = "each face has one radiance, wherever it moves" if moves else "nothing asks for it"
    reasons = [label(name) for name in ("colors", "uvs", "texels") if name in wanted]
    reasons += ["radiance varies over faces that move"] if work.motion else []

    has_discontinuities, lines, unseen = flat.has_discontinuities, counts["discontinuity_lines"], "none in view"
    no_discontinuities = "" if work.discontinuities else "no alpha edge, and no nearest texels"
    if not work.discontinuities and has_discontinuities:
        no_discontinuities = "nothing that moves them" if request.gradient.visibility else "visibility=False"
    topology = "edges, found once for a set of faces"
    inside = ", ".join(reasons) + _bound(surface, counts["surface_wanted"])
    jumps = "what moves shows where radiance jumps" + _bound(edge, counts["edge_wanted"])
    lens = f"where the lens folds or ends, {lens_boundary:,} px in view"
    of_surface, of_edges = ("faces in view", "controls", "surface samples"), ("edges in view", "edge samples")
    terms = {
        "view": term(any(work), "", "vertices and importance map of the image", "nothing asks for it", "view"),
        "interior": term(surface, no_interior, inside, "nothing in view", *of_surface, samples=surface),
        "topology": term(work.boundary, no_boundary, topology, topology, "topology"),
        "boundary": term(edge, no_boundary, jumps, "no jump in view", *of_edges, samples=edge),
        "silhouettes": term(silhouettes, no_boundary, f"{silhouettes:,} in view", unseen),
        "creases": term(creases, no_boundary, f"{creases:,} in view", "nothing jumps between neighbours", "creases"),
        "intersections": term(intersections, no_boundary, f"{intersections:,} in view", unseen, "intersections"),
        "lens boundary": term(lens_boundary, no_boundary or no_lens_boundary, lens, "no lens ends in view"),
        "discontinuities": term(lines, no_discontinuities, f"on {lines:,} lines over faces", unseen, "discontinuities"),
    }
    for name in SLOTS:
        why = "required; summed in double" if name in wanted else "not required"
        terms[f"{label(name)} gradient"] = Term(name in wanted, why, bytes=8 * request.slot(name).numel())
    return terms


def _bound(samples: int, wanted: int) -> str:
    """Return the text where the budget (csrc/estimator/budget.h) may cut the default samples."""
    return f"; by default up to {wanted:,}, but no more than take the image's time" if 0 < samples < wanted else ""


def _bytes_of_copies(scene: Scene, flat: Flat) -> int:
    """Return the bytes of the flat arrays that are not the user's own tensors."""
    tensors = [value for mesh in scene.meshes for value in vars(mesh).values() if isinstance(value, Tensor)]
    tensors += [] if scene.background is None else [scene.background]
    own = {tensor.untyped_storage().data_ptr() for tensor in tensors}
    copies = {
        storage.data_ptr(): storage.nbytes() for storage in (t.untyped_storage() for t in flat if isinstance(t, Tensor))
    }
    return sum(size for where, size in copies.items() if where not in own)


def _count(n: int) -> str:
    return f"{n:,}" if n else ""
