"""Draws the figures of concepts.md, how-it-works/ and gallery.md:  python docs/figures.py [FOLDER]"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
import trimesh
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch
from torch import Tensor

import edgegrad as eg
from edgegrad.image import linear_to_srgb

sys.path.append(str(Path(__file__).parents[1] / "examples"))
import body as body_example
import sun  # the fit of examples/sun.py, in a larger picture

INK, BLUE, ORANGE, GREY = "#222222", "#1f6fb2", "#d9730d", "#8a8f98"
SAMPLES = {"sampling": eg.Sampling(surface=2_000_000, edges=1_000_000)}


def picture(axis: Axes, image: Tensor, title: str) -> None:
    axis.imshow(linear_to_srgb(image.clamp(0, 1)))
    axis.set_title(title, fontsize=10)
    axis.axis("off")


def signed(axis: Axes, values: Tensor, title: str, scale: float) -> None:
    """A derivative, summed over the channels: blue where it falls, red where it rises."""
    axis.imshow(values, cmap="RdBu_r", vmin=-scale, vmax=scale)
    axis.set_title(title, fontsize=10)
    axis.axis("off")


def torus() -> eg.Mesh:
    shape = trimesh.creation.torus(0.7, 0.3, major_sections=96, minor_sections=48)
    verts = torch.tensor(shape.vertices, dtype=torch.float32)
    colors = 0.5 + 0.4 * torch.sin(4.0 * verts + torch.tensor([0.0, 2.0, 4.0]))
    return eg.Mesh(verts, torch.tensor(shape.faces), colors=colors)


def derivatives(folder: Path) -> None:
    """Forward mode in three directions, and where the content should go for a loss."""
    mesh, size = torus(), 240
    camera = eg.Camera.look_at((0.4, -2.2, 2.4), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, (size, size))
    scene = eg.Scene(mesh, torch.tensor([0.9, 0.92, 0.95]))
    right = camera.world_to_camera[0, :3]
    axis = torch.tensor([0.0, 0.0, 1.0])
    directions = torch.stack(
        [
            right.expand_as(mesh.verts),
            torch.linalg.cross(axis.expand_as(mesh.verts), mesh.verts),
            mesh.verts,
        ]
    )
    image, dots = eg.jvp(scene, camera, {mesh.verts: directions}, 64, **SAMPLES)
    turn = torch.linalg.matrix_exp(0.12 * torch.tensor([[0.0, -1.0, 0.4], [1.0, 0.0, 0.2], [-0.4, -0.2, 0.0]]))
    target = eg.render(scene.transformed(turn, torch.tensor([0.12, 0.0, -0.05])), camera, 64)
    adjoint = 2 * (image - target)
    screen = eg.screen_gradient(scene, camera, adjoint, 64, **SAMPLES)

    figure, axes = plt.subplots(1, 6, figsize=(15, 2.9))
    picture(axes[0], image, "image")
    for a, dot, title in zip(axes[1:4], dots, ("… as it moves right", "… turns", "… grows"), strict=True):
        signed(a, dot.sum(-1), "its derivative " + title if a is axes[1] else title, 6.0)
    picture(axes[4], 0.5 + 0.5 * (image - target), "image − target")
    # Sums over squares of pixels, as arrows against the gradient.
    block = 8
    arrows = -screen.reshape(size // block, block, size // block, block, 2).sum((1, 3))
    x = (torch.arange(size // block) + 0.5) * block
    length = arrows.norm(dim=-1)
    strong = length > 0.04 * length.max()
    axes[5].imshow(linear_to_srgb(target.clamp(0, 1)), alpha=0.35)
    scaled = arrows / length.max().sqrt() / length.sqrt().clamp(min=1e-12)[..., None]
    X, Y = torch.meshgrid(x, x, indexing="xy")
    axes[5].quiver(
        X[strong],
        Y[strong],
        scaled[..., 0][strong],
        scaled[..., 1][strong],
        angles="xy",
        scale=11,
        color=ORANGE,
        width=0.006,
    )
    axes[5].set_title("where the image should go", fontsize=10)
    axes[5].axis("off")
    figure.tight_layout()
    figure.savefig(folder / "derivatives.png", dpi=110)


def light(folder: Path) -> None:
    """The direction of the sun and the pose of an object, from one picture."""
    camera = sun.view(256)
    target = sun.picture(sun.TRUTH, camera, 10_000, seeds=64)
    found = sun.fit(target, camera)
    start, end = (sun.picture(guess, camera, 20_000, seeds=64) for guess in (sun.START, found))
    for name, guess in (("start", sun.START), ("fit", found)):
        print(name, "sun {:.2f}°, pose {:.2f}°, distance {:.4f}".format(*guess.errors(sun.TRUTH)))
    figure, axes = plt.subplots(1, 4, figsize=(12, 3.4))
    shown = {"target": target, "start": start, "fit": end, "difference × 4": 4 * (end - target).abs()}
    for axis, (title, image) in zip(axes, shown.items(), strict=True):
        picture(axis, image, title)
    figure.tight_layout(pad=0.6)
    figure.savefig(folder / "light.png", dpi=100)


def bounces(folder: Path) -> None:
    """A room by how often light is scattered, and how its image changes as the block moves to the right."""
    room, size = corner_room(), 160
    camera = eg.Camera.look_at((0.0, -3.4, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 38.0, (size, size))
    figure, axes = plt.subplots(1, 7, figsize=(16, 2.7))
    for axis, count in zip(axes, (1, 2, 4, 8), strict=False):
        picture(axis, eg.render(room, camera, 64, bounces=count), f"bounces={count}")
    *others, block = room.meshes
    right = torch.tensor([1.0, 0.0, 0.0]).expand(1, len(block.verts), 3)
    samples = {"sampling": eg.Sampling(surface=600_000, edges=300_000)}

    def derivative(count: int, visibility: bool = True) -> Tensor:
        scene = eg.Scene([*others, block])
        _, dot = eg.jvp(scene, camera, {block.verts: right}, 4, bounces=count, visibility=visibility, **samples)
        return dot[0].mean(-1)

    whole, inside, direct = derivative(2), derivative(2, False), derivative(1)
    terms = {
        "the block moves right": whole,
        "inside of faces, × 4": 4 * inside,
        "by the second bounce, × 4": 4 * (whole - direct),
    }
    for axis, (title, term) in zip(axes[4:], terms.items(), strict=True):
        signed(axis, term, title, 3.0)
    figure.tight_layout(pad=0.6)
    figure.savefig(folder / "bounces.png", dpi=100)


def corner_room() -> eg.Scene:
    """Open to the front, with walls in colours and a lamp; the last mesh is a block."""

    def quad(*corners: tuple[float, float, float], **material: object) -> eg.Mesh:
        faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        return eg.Mesh(torch.tensor(corners), faces, material=eg.Material(**material))  # type: ignore[arg-type]

    white, red, green = torch.full((3,), 0.75), torch.tensor([0.7, 0.15, 0.1]), torch.tensor([0.15, 0.6, 0.2])
    a, b, c, d = (-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)
    walls = [
        quad(*((x, y, 0.0) for x, y in (a, b, c, d)), base_color=white),
        quad(*((x, y, 2.0) for x, y in (d, c, b, a)), base_color=white),
        quad((*d, 0.0), (*c, 0.0), (*c, 2.0), (*d, 2.0), base_color=white),
        quad((*a, 0.0), (*d, 0.0), (*d, 2.0), (*a, 2.0), base_color=red),
        quad((*b, 0.0), (*b, 2.0), (*c, 2.0), (*c, 0.0), base_color=green),
    ]
    emitting = eg.Material(base_color=0.0, emission=7.0, two_sided=False)
    lamp = eg.shapes.rectangle((0.0, 0.0, 1.98), (0.4, 0.0, 0.0), (0.0, -0.4, 0.0), material=emitting)
    box = trimesh.creation.box((0.6, 0.7, 0.7), trimesh.transformations.rotation_matrix(0.4, (0, 0, 1), (0, 0, 0)))
    verts = torch.tensor(box.vertices, dtype=torch.float32) + torch.tensor([-0.2, 0.15, 0.5])
    return eg.Scene([*walls, lamp, eg.Mesh(verts, torch.tensor(box.faces), material=eg.Material(white))])


def triangle_terms(folder: Path) -> None:
    """The two terms of the derivative of a triangle that moves right, its red channel, and finite differences."""
    verts = torch.tensor([[-0.9, -0.7, 0.0], [0.9, -0.5, 0.0], [-0.1, 0.9, 0.0]], dtype=torch.float64)
    colors = torch.tensor([[1.0, 0.5, 0.1], [0.0, 0.4, 0.9], [0.9, 0.95, 0.8]], dtype=torch.float64)
    mesh = eg.Mesh(verts, torch.tensor([[0, 1, 2]]), colors=colors)
    camera = eg.Camera.orthographic((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.4, (48, 48))
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(1, 3, 3)
    scene = eg.Scene(mesh, torch.full((3,), 0.15, dtype=torch.float64))
    options = {"spp": 256, **SAMPLES}
    image, whole = eg.jvp(scene, camera, {verts: right}, **options)
    _, inside = eg.jvp(scene, camera, {verts: right}, visibility=False, **options)
    h = 0.01
    high, low = (eg.render(scene.transformed(t=s * h * right[0, 0]), camera, 1024) for s in (1, -1))
    figure, axes = plt.subplots(1, 5, figsize=(13, 2.9))
    picture(axes[0], image, "a triangle moves right")
    terms = {
        "inside: colours pass by": inside[0],
        "boundary: its edges sweep pixels": (whole - inside)[0],
        "both": whole[0],
        "finite differences": (high - low) / (2 * h),
    }
    for axis, (title, term) in zip(axes[1:], terms.items(), strict=True):
        signed(axis, term[..., 0], title, 1.5)
    figure.tight_layout()
    figure.savefig(folder / "two-terms.png", dpi=110)


def curve_source(folder: Path) -> None:
    """A sample on a curve: its ray, its two sides, the normal velocity."""
    figure, (space, image) = plt.subplots(1, 2, figsize=(11, 3.4), width_ratios=[1.5, 1])
    space.plot([0], [0], "o", color=INK)
    space.annotate("camera", (0, -0.35), ha="center", fontsize=10)
    space.plot([3.0, 4.6], [0.6, -1.4], color=BLUE, lw=3)
    space.annotate("face that ends at the edge:\nL₋, known exactly", (4.7, -1.35), color=BLUE, fontsize=10, va="center")
    space.plot([5.4, 6.2], [2.0, -0.2], color=GREY, lw=3)
    space.annotate("what the ray finds behind:\nL₊", (6.3, 1.1), color=GREY, fontsize=10, va="center")
    space.annotate("", (5.75, 1.15), (0, 0), arrowprops={"arrowstyle": "->", "color": ORANGE, "lw": 1.8})
    space.plot([3.0], [0.6], "o", color=ORANGE)
    space.annotate(
        "p(t) on the edge; the ray\nignores the edge's faces", (2.3, 1.0), color=ORANGE, fontsize=10, ha="center"
    )
    space.set_xlim(-0.6, 9.2), space.set_ylim(-2.0, 2.4)
    space.set_aspect("equal"), space.axis("off")
    image.fill([0, 2.2, 3.4, 0], [0, 0, 3, 3], color=BLUE, alpha=0.25, lw=0)
    image.fill([2.2, 5, 5, 3.4], [0, 0, 3, 3], color=GREY, alpha=0.25, lw=0)
    image.plot([2.2, 3.4], [0, 3], color=INK, lw=2)
    image.plot([2.8], [1.5], "o", color=ORANGE)
    image.annotate("", (3.15, 2.375), (2.8, 1.5), arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.6})
    image.annotate("dx/ds", (3.25, 2.3), fontsize=10)
    image.annotate("", (3.9, 1.06), (2.8, 1.5), arrowprops={"arrowstyle": "->", "color": ORANGE, "lw": 1.6})
    image.annotate(
        "δx ∧ dx/ds: how fast\nthe curve moves\nalong its normal", (3.0, 0.15), fontsize=9.5, va="top", color=ORANGE
    )
    image.annotate("L₋", (0.9, 1.4), fontsize=13, color=BLUE), image.annotate("L₊", (4.4, 2.4), fontsize=13, color=INK)
    image.set_title("in the image", fontsize=10)
    image.set_xlim(0, 5), image.set_ylim(3, 0)
    image.set_aspect("equal"), image.axis("off")
    figure.tight_layout()
    figure.savefig(folder / "curve-source.png", dpi=110)


def stages(folder: Path) -> None:
    """Sample, shade, accumulate: the three stages and what each holds."""
    columns = [
        ("sample", BLUE, ["points on faces", "points of pixels", "points on curves:\nedges, intersections"]),
        ("shade", INK, ["radiance of a surface point:\ncolours, textures", "its vjp and its jvp"]),
        (
            "accumulate",
            ORANGE,
            [
                "reverse: adjoints of vertices,\ncolours, textures, camera",
                "forward: tangents of pixels",
                "by place: (H, W, 2)",
            ],
        ),
    ]
    figure, axis = plt.subplots(figsize=(11, 2.7))
    for k, (name, color, items) in enumerate(columns):
        x = 3.8 * k
        axis.add_patch(FancyBboxPatch((x, 0), 3.1, 2.4, boxstyle="round,pad=0.08", fc="white", ec=color, lw=1.8))
        axis.text(x + 1.55, 2.16, name, ha="center", va="center", fontsize=12, weight="bold", color=color)
        for i, item in enumerate(items):
            axis.text(x + 1.55, 1.65 - 0.66 * i, item, ha="center", va="center", fontsize=9.5, color=INK)
        if k:
            axis.annotate("", (x - 0.1, 1.2), (x - 0.6, 1.2), arrowprops={"arrowstyle": "->", "lw": 2, "color": GREY})
    axis.set_xlim(-0.2, 11), axis.set_ylim(-0.2, 2.6)
    axis.axis("off")
    figure.tight_layout()
    figure.savefig(folder / "stages.png", dpi=110)


def cup(folder: Path) -> None:
    """The fit of a notebook, from aside too. Photograph: coffee of scikit-image, by Rachel Michetti, CC0."""
    found = runpy.run_path(str(Path(__file__).parents[1] / "notebooks" / "10_a_photograph.py"))
    plt.close("all")
    seen = {
        name: found["outlined"](eg.render_aovs(scene, found["camera"], ["alpha"])["alpha"], found["photo"])
        for name, scene in (("start", found["fit"].start), ("fit", found["fit"].scene))
    }
    aside = found["solid"].replace(background=torch.ones(3))
    shown = {
        "photograph": found["photo"], **seen,
        "from aside": eg.render(aside, found["views"]["lower"], 64, shader=found["from_photo"]),
    }  # fmt: skip
    figure, axes = plt.subplots(1, len(shown), figsize=(13, 2.5))
    for axis, (title, image) in zip(axes, shown.items(), strict=True):
        picture(axis, image, title)
    figure.tight_layout()
    figure.savefig(folder / "cup.jpg", dpi=110, pil_kwargs={"quality": 88})


def body(folder: Path) -> None:
    """The fit of examples/body.py, from two sides."""
    rig, truth, _, fit = body_example.trial(0, progress=False)
    print(body_example.Errors.of(rig, fit.values["rotations"], truth))
    rows = body_example.pictures(rig, truth, fit, 320)
    figure, axes = plt.subplots(1, 6, figsize=(12, 3.4))
    for axis, (title, image) in zip(axes, (item for row in rows for item in row.items()), strict=True):
        picture(axis, image[30:-15, 70:-70], title)
    figure.tight_layout(pad=0.8)
    figure.savefig(folder / "body.png", dpi=100)


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (light, bounces, derivatives, triangle_terms, curve_source, stages, cup, body):
        draw(folder)


if __name__ == "__main__":
    main()
