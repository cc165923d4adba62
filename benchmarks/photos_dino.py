"""Shape and texture of a real figure from calibrated photographs: 12 of 16 views are fitted, 4 are held out.

    python -m benchmarks.photos_dino FOLDER [--first 2] [--out dino.png]

FOLDER holds the data set dinoSparseRing of the Middlebury multi-view benchmark (Seitz et al. 2006): a matte white figure before
black, 640 × 480, `dinoSR_par.txt` with K, R and t of each view. Silhouettes are where a picture is brighter than 0.15. Dark
shadows on the figure are as dark as what is behind it, so pixels that a closing by 9 would add are not known, as the data's
notes advise: they have no weight, in the fit and in the IoU. Held out is every fourth view.

Printed are, for each view held out, the IoU of the silhouettes where they are known, and over all pixels; and the PSNR of the
textured render, of sRGB values from 0 to 1, over the known mask and over the whole picture with its background put to black.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, Refinement, fit_shape, fit_texture, regularizers
from edgegrad.fit.descent.result import Fit
from edgegrad.image import linear_to_srgb, srgb_to_linear

BRIGHT = 0.15  # of the brightest channel, sRGB
SPECKS, SHADOWS = 2, 9  # pixels that closings fill: noise; what may be a shadow
TEXELS = 512


@dataclass(frozen=True)
class Photo:
    name: str
    camera: eg.Camera
    image: Tensor  # (H, W, 3) linear
    mask: Tensor  # (H, W)
    known: Tensor  # (H, W), 0 where the mask may be a shadow's

    def resized(self, factor: float) -> Photo:
        H, W = self.camera.size
        size = round(H * factor), round(W * factor)

        def smaller(x: Tensor) -> Tensor:
            x = x.reshape(*x.shape[:2], -1).movedim(-1, 0)[None]
            return torch.nn.functional.interpolate(x, size=size, mode="area")[0].movedim(0, -1)

        known = (smaller(self.known)[..., 0] > 0.99).float()
        mask, image = smaller(self.mask)[..., 0], smaller(self.image)
        return replace(self, camera=self.camera.resized(size), image=image, mask=mask, known=known)


def read(folder: Path) -> list[Photo]:
    photos = []
    for line in (folder / "dinoSR_par.txt").read_text().splitlines()[1:]:
        name, *numbers = line.split()
        values = torch.tensor([float(n) for n in numbers], dtype=torch.float64)
        K, R, t = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
        image = eg.read_image(folder / name, channels=3)
        camera = eg.Camera.from_opencv(R.float(), t.float(), K.float(), (image.shape[0], image.shape[1]))
        found = _largest(_closed(image.amax(-1).numpy() > float(srgb_to_linear(torch.tensor(BRIGHT))), SPECKS))
        perhaps = ndimage.binary_fill_holes(_closed(found, SHADOWS))
        mask, known = (torch.from_numpy(x).float() for x in (found, ~(perhaps & ~found)))
        photos.append(Photo(name, camera, image, mask, known))
    return photos


def _closed(mask: np.ndarray, radius: int) -> np.ndarray:
    """Dilated and eroded by a disc; what touches the rim goes on beyond it."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    wide = np.pad(mask, 2 * radius, mode="edge")
    return ndimage.binary_closing(wide, x * x + y * y <= radius**2)[2 * radius : -2 * radius, 2 * radius : -2 * radius]


def _largest(mask: np.ndarray) -> np.ndarray:
    label, count = ndimage.label(mask)  # type: ignore[misc]
    return label == 1 + np.argmax(ndimage.sum(mask, label, range(1, count + 1)))


def shape(photos: list[Photo], steps: int = 150) -> Fit:
    """Fit the smallest surface that has the silhouettes, from the visual hull."""
    masks = [torch.maximum(p.mask, 1.0 - p.known) for p in photos]
    start = eg.shapes.visual_hull(masks, [p.camera for p in photos], resolution=64, faces=4000)

    def fit(mesh: eg.Mesh, photos: list[Photo], small: float, **how: Any) -> Fit:
        return fit_shape(
            mesh, None, [p.camera for p in photos], masks=[p.mask for p in photos], weights=[p.known for p in photos],
            regularizer=lambda scene: small * regularizers.area(scene.meshes[0].verts, scene.meshes[0].faces),
            refinement=Refinement(2, lr=0.002, **how), options=FitOptions(seed=0, steps=steps, spp=4, views_per_step=4),
        )  # fmt: skip

    # First what no view needs is taken away, then contours are followed to the pixel.
    carved = fit(start, [p.resized(0.5) for p in photos], 0.08, faces=5000)
    return fit(carved.mesh, photos, 0.03, faces=20000)


def refined(mesh: eg.Mesh, photos: list[Photo], rounds: int = 3) -> Iterator[eg.Mesh]:
    """Fit a texture, then in turns the shape under that texture, and the texture again.

    Contours do not show what is hollow, but a texture slides on a surface that is not where the figure's is.
    """
    half = [p.resized(0.5) for p in photos]
    cameras, images = [p.camera for p in half], [p.image for p in half]
    masks, weights = [p.mask for p in half], [p.known for p in half]

    def textured(mesh: eg.Mesh, steps: int) -> eg.Mesh:
        return fit_texture(
            mesh,
            images,
            cameras,
            TEXELS,
            masks=masks,
            weights=weights,
            lr=0.05,
            options=FitOptions(seed=0, steps=steps, spp=4, views_per_step=4),
        ).mesh

    found = textured(eg.textures.unwrap(mesh, TEXELS), 60)
    yield found
    for _ in range(rounds):
        known = found

        def look(bare: eg.Mesh, known: eg.Mesh = known) -> eg.Mesh:
            return known.replace(verts=bare.verts)

        moved = fit_shape(
            known, images, cameras, masks=masks, weights=weights, appearance=look,
            regularizer=lambda scene: 0.02 * regularizers.area(scene.meshes[0].verts, scene.meshes[0].faces),
            refinement=Refinement(levels=1, lr=0.004), options=FitOptions(seed=0, steps=130, spp=2, views_per_step=3),
        )  # fmt: skip
        found = textured(known.replace(verts=moved.mesh.verts), 40)
        yield found


def iou(a: Tensor, b: Tensor, weight: Tensor | float = 1.0) -> float:
    return float((weight * torch.minimum(a, b)).sum() / (weight * torch.maximum(a, b)).sum())


def psnr(render: Tensor, photo: Tensor, weight: Tensor) -> float:
    """dB, of linear images, compared as sRGB."""
    apart = (linear_to_srgb(render.clamp(0, 1)) - linear_to_srgb(photo.clamp(0, 1))).square().mean(-1)
    return -10.0 * math.log10(float((weight * apart).sum() / weight.sum()))


def measured(mesh: eg.Mesh, photo: Photo) -> tuple[dict[str, float], Tensor, Tensor]:
    """Numbers of one view, render and alpha."""
    found = eg.render_aovs(mesh, photo.camera, ["image", "alpha"], spp=32)
    image, alpha = found["image"], found["alpha"][..., 0]
    black = photo.image * photo.mask[..., None]
    numbers = {
        "IoU": iou(alpha, photo.mask, photo.known), "IoU all": iou(alpha, photo.mask),
        "PSNR mask": psnr(image, photo.image, photo.mask * photo.known), "PSNR all": psnr(image, black, photo.known),
    }  # fmt: skip
    return numbers, image, alpha


def sheet(rows: list[tuple[Photo, Tensor, Tensor]]) -> Tensor:
    """photograph | render | photograph with the render's contour, of each view held out."""
    lines = []
    for photo, image, alpha in rows:
        inside = (alpha > 0.5).numpy()
        rim = torch.from_numpy(inside ^ ndimage.binary_erosion(inside))
        marked = torch.where(rim[..., None], torch.tensor([1.0, 0.0, 0.0]), photo.image)
        lines.append(torch.cat([photo.image, image, marked], 1))
    return torch.cat(lines)


def dino(folder: Path, first: int = 2, out: Path | None = None) -> None:
    photos = read(folder)
    held, seen = photos[first::4], [p for i, p in enumerate(photos) if i % 4 != first]
    began = time.perf_counter(), time.process_time()
    found = bare = shape(seen).mesh
    report("by contours", began, bare, held, seen)
    for k, found in enumerate(refined(bare, seen)):
        report("textured" if k == 0 else f"refined {k}", began, found, held, seen)
    if out is not None and found.texture is not None:
        eg.write_image(out, sheet([(photo, *measured(found, photo)[1:]) for photo in held]))
        eg.save_mesh(out.with_suffix(".glb"), found.replace(texture=found.texture.clamp(0.0, 1.0)))


def report(stage: str, began: tuple[float, float], mesh: eg.Mesh, held: list[Photo], seen: list[Photo]) -> None:
    """Print a line for each view held out, and the mean of the fitted views."""
    wall, work = time.perf_counter() - began[0], time.process_time() - began[1]
    print(f"{stage}, after {wall:.0f} s, {work:.0f} s of processor time")
    rows = {photo.name: measured(mesh, photo)[0] for photo in held}
    others = [measured(mesh, photo)[0] for photo in seen]
    rows["fitted, mean"] = {name: sum(o[name] for o in others) / len(others) for name in others[0]}
    for title, numbers in rows.items():
        shown = (f"{name} {x:.3f}" for name, x in numbers.items() if mesh.texture is not None or name.startswith("IoU"))
        print(f"{title:>16}  " + "  ".join(shown), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--first", type=int, choices=range(4), default=2, help="the first view held out, from 0 (2)")
    parser.add_argument("--out", type=Path, help="a picture sheet, and the mesh beside it as .glb")
    args = parser.parse_args()
    dino(args.folder, args.first, args.out)


if __name__ == "__main__":
    main()
