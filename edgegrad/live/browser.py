"""The live view as a page in a browser, served by viser."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..camera.camera import Camera
from ..files.formats.gltf_pack import to_glb
from ..optional import require
from ..scene.material import Material, vertex_normals
from ..scene.mesh import PLAIN, Mesh
from ..scene.tree import named_tensors
from .frame import BONE, CONTRAST, Frame, as_bytes, displayed

WIDTH = 480  # pixels of the panel beside the scene
THUMBNAIL = 128  # pixels on the longer side of a picture in a frustum
FRUSTUM = 0.12  # its size as a part of the distance from the cameras to the meshes
WIDEST = 2.0  # radians of a frustum; a camera that has no field of view gets
NOMINAL = 0.6
AMBIENT = 1.5
FOV, ASIDE = 0.8, 0.9  # radians of the page's own camera, and between it and the cameras shown
SEE_THROUGH = 0.6  # opacity of a mesh about its bones
MOST_POINTS = 500  # of the curve
GREY = (round(255 * (1.055 * PLAIN ** (1 / 2.4) - 0.055)),) * 3  # sRGB
PANEL_TITLE = f"target | render | difference × {CONTRAST}"


class Controls(NamedTuple):
    """What the page's buttons call, from threads of the server."""

    pause: Callable[[], None]
    stop: Callable[[], None]
    look: Callable[[int], None]  # through another camera


class _Shown(NamedTuple):
    mesh: Mesh
    handle: Any  # viser's


class Browser:
    """The page. Raises ImportError without viser, OSError where the host has no free port."""

    def __init__(self, host: str, port: int, controls: Controls) -> None:
        viser = require("viser", "edgegrad[view]", "the live view")
        with _quiet():
            self.server: Any = viser.ViserServer(host, port, verbose=False)
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "") else host
        self.url = f"http://{shown}:{self.server.get_port()}"
        self._rotation = viser.transforms.SO3.from_matrix
        self._meshes: dict[int, _Shown] = {}
        self._frusta: list[tuple[Tensor | None, Any]] = []
        self._bones: Any = None
        # Colours that are radiance have their light in them: an even light beside the page's own shows them, and the shape.
        self.server.scene.configure_default_lights(cast_shadow=False)
        self.server.scene.add_light_ambient("/light", intensity=AMBIENT)
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)  # which would open the page to everyone
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        gui.set_panel_label("edgegrad")
        self.status = gui.add_markdown("waiting for the first step")
        self.pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="red")
        self.view = gui.add_dropdown("view", ("1",), visible=False)
        self.picture: Any = None
        self.curve: Any = None
        self.pause.on_click(lambda _: controls.pause())
        self.stop.on_click(lambda _: controls.stop())
        self.view.on_update(lambda event: controls.look(int(event.target.value) - 1))

    def draw(self, frame: Frame, index: int, losses: Sequence[float], state: str) -> None:
        first = not self._meshes
        if first:
            self._look_from_aside(frame)
        with self.server.atomic():
            self._draw_meshes(frame)
            self._draw_bones(frame)
            self._draw_cameras(frame)
        self.draw_panel(frame, index)
        self.say(state)
        self._draw_curve(losses)

    def draw_panel(self, frame: Frame, index: int) -> None:
        if not frame.cameras:
            return
        picture = np.concatenate(frame.panel(index), axis=1)
        if self.picture is None:
            self.picture = self.server.gui.add_image(picture, label=PANEL_TITLE, order=self.view.order + 0.1)
        self.picture.image = picture

    def say(self, state: str) -> None:
        self.status.content = state

    def label(self, pause: str, stop: str) -> None:
        self.pause.label, self.stop.label = pause, stop

    def close(self) -> None:
        with _quiet():
            self.server.stop()

    # -- the scene --------------------------------------------------------------------------------------------------------

    def _look_from_aside(self, frame: Frame) -> None:
        """Where a page that opens looks from: beyond the cameras, between them, so that they do not hide the meshes."""
        low, high = _bounds(frame)
        center, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        up, away = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.3, 1.0])
        distance = size
        if frame.cameras:
            poses = [camera.world_to_camera.detach().double().numpy() for camera in frame.cameras]
            mean = -np.mean([pose[1, :3] for pose in poses], axis=0)
            up = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 0.1 else -poses[0][1, :3]
            offsets = np.stack([camera.eye.detach().double().numpy() for camera in frame.cameras]) - center
            lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
            distance = max(float(lengths.max()), 0.5 * size)
            away = 1.4 * _apart(offsets / (lengths + 1e-30), up)
            center = center + 0.4 * offsets.mean(0)  # to have both in the picture
        self.distance = distance
        self.server.scene.set_up_direction(tuple(up))
        start = self.server.initial_camera
        start.near, start.far = 1e-3 * distance, 1e3 * distance
        places = [start, *(client.camera for client in self.server.get_clients().values())]
        for camera in places:  # those who came before there was anything to see look there too
            camera.position, camera.look_at = center + distance * away, center
            camera.fov = FOV

    def _draw_meshes(self, frame: Frame) -> None:
        place: dict[str, Any] = {}
        if frame.matrix is not None:
            M = frame.matrix.detach().double().numpy()
            scale = float(np.cbrt(np.linalg.det(M[:3, :3])))
            place = {"wxyz": self._rotation(M[:3, :3] / scale).wxyz, "position": M[:3, 3], "scale": scale}
        for i, mesh in enumerate(frame.scene.meshes):
            old = self._meshes.get(i)
            if old is None or not _alike(old.mesh, mesh):
                simple = _Simple.of(mesh)
                same = old is not None and simple is not None and simple == _Simple.of(old.mesh)
                if old and same and torch.equal(old.mesh.faces, mesh.faces):
                    handle = old.handle
                    handle.vertices = _floats(mesh.verts)
                else:
                    handle = self._added(f"/meshes/{i}", mesh, 1.0 if frame.bones is None else SEE_THROUGH)
                self._meshes[i] = _Shown(mesh, handle)
            for name, value in place.items():
                setattr(self._meshes[i].handle, name, value)

    def _added(self, name: str, mesh: Mesh, opacity: float) -> Any:
        """Takes the place of one of that name."""
        if (simple := _Simple.of(mesh)) is not None:
            faces = mesh.faces.numpy().astype(np.uint32)
            see_through = {"opacity": opacity} if opacity < 1.0 else {}
            return self.server.scene.add_mesh_simple(
                name, _floats(mesh.verts), faces, **simple._asdict(), **see_through
            )
        mesh = mesh.detach()
        if mesh.face_colors is not None:  # of corners they are written faster
            mesh = mesh.replace(corner_colors=mesh.face_colors[:, None].expand(-1, 3, -1))
        if mesh.material is None:  # matt and smooth
            mesh = mesh.replace(material=Material(), normals=vertex_normals(mesh.verts, mesh.faces), normal_faces=None)
        if opacity < 1.0 and mesh.alpha is None and mesh.material is not None:
            own = mesh.uvs is not None
            anywhere = {} if own else {"uvs": torch.zeros(1, 2), "uv_faces": torch.zeros_like(mesh.faces)}
            blends = mesh.material.replace(alpha_mode="BLEND")
            mesh = mesh.replace(alpha=torch.full((1, 1), opacity), material=blends, **anywhere)
        return self.server.scene.add_glb(name, to_glb(mesh)[0])

    def _draw_bones(self, frame: Frame) -> None:
        if frame.bones is None:
            return
        points = frame.bones.detach().float().numpy()
        if self._bones is None or len(self._bones.points) != len(points):
            color = tuple(round(255 * value) for value in BONE)
            self._bones = self.server.scene.add_line_segments(
                "/bones", points, color, thickness=3.0, thickness_units="screen"
            )
        self._bones.points = points

    def _draw_cameras(self, frame: Frame) -> None:
        if len(frame.cameras) != len(self._frusta):
            for _, handle in self._frusta:
                handle.remove()
            self._frusta = [(None, self._frustum(i, camera)) for i, camera in enumerate(frame.cameras)]
            if len(frame.cameras) > 1:
                self.view.options = [str(i + 1) for i in range(len(frame.cameras))]
            self.view.visible = len(frame.cameras) > 1
        for i, (camera, target) in enumerate(zip(frame.cameras, frame.targets, strict=True)):
            old, handle = self._frusta[i]
            for name, value in self._placed(camera).items():
                if not np.array_equal(getattr(handle, name), value):
                    setattr(handle, name, value)
            if target is not None and target is not old:
                handle.image = _thumbnail(target)
            self._frusta[i] = target, handle

    def _frustum(self, i: int, camera: Camera) -> Any:
        place = self._placed(camera)
        scale = FRUSTUM * self.distance
        thickness = 0.015 * scale
        return self.server.scene.add_camera_frustum(
            f"/cameras/{i}", scale=scale, thickness=thickness, color=(40, 90, 200), **place
        )

    def _placed(self, camera: Camera) -> dict[str, Any]:
        (H, W), K = camera.size, camera.K.detach().double().numpy()
        R = camera.world_to_camera.detach().double().numpy()[:3, :3]
        fov = NOMINAL
        if camera.projection != "orthographic":
            fov = min(WIDEST, math.radians(abs(float(camera.fov_y.detach()))))
        aspect = W * abs(float(K[1, 1])) / (H * abs(float(K[0, 0])))
        position = camera.eye.detach().double().numpy()
        return {"wxyz": self._rotation(R.T).wxyz, "position": position, "fov": fov, "aspect": aspect}

    # -- the panel --------------------------------------------------------------------------------------------------------

    def _draw_curve(self, losses: Sequence[float]) -> None:
        every = max(1, math.ceil(len(losses) / MOST_POINTS))
        steps = np.arange(1, len(losses) + 1, dtype=np.float64)[::every]
        values = np.array(losses, np.float64)[::every]
        kept = np.isfinite(values)
        if kept.sum() < 2:
            return
        positive = bool(values[kept].min() > 0.0)
        data = steps[kept], np.log10(values[kept]) if positive else values[kept]
        title = "loss, as a power of ten" if positive else "loss"
        if self.curve is None:
            line = {"label": "loss", "stroke": "#2850c8", "width": 2}
            self.curve = self.server.gui.add_uplot(
                data, ({"label": "step"}, line), title=title, scales={"x": {"time": False}}, aspect=2.0,
                legend={"show": False},
            )  # fmt: skip
        else:
            self.curve.data, self.curve.title = data, title


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser prints a banner, through rich, which it brings."""
    console = require("rich", "edgegrad[view]", "the live view").get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _apart(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The direction nearest to the first of some that is ASIDE from all, or as far as can be; from above."""
    e = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    e /= np.linalg.norm(e)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 5)), np.radians([15, 30, 45, 60]))
    flat = np.cos(azimuth)[..., None] * e + np.sin(azimuth)[..., None] * np.cross(up, e)
    candidates = (np.cos(elevation)[..., None] * flat + np.sin(elevation)[..., None] * up).reshape(-1, 3)
    cosines = candidates @ directions.T
    nearest = np.maximum(cosines.max(1), np.cos(ASIDE))
    return candidates[np.argmin(nearest - 1e-3 * cosines[:, 0])]


class _Simple(NamedTuple):
    """How a mesh of one matt colour looks. Where it moves, its vertices alone are sent."""

    color: tuple[int, ...]  # sRGB
    side: str
    flat_shading: bool

    @staticmethod
    def of(mesh: Mesh) -> _Simple | None:
        """None of a mesh that needs more than that. Colours of other than 1 or 3 channels cannot be shown."""
        material = mesh.material
        if mesh.channels not in (None, 1, 3):
            return _Simple(GREY, "double", False)
        if (
            mesh.alpha is not None
            or mesh.has_textures
            or not (mesh.colors is mesh.face_colors is mesh.corner_colors is None)
        ):
            return None
        if material is None:
            return _Simple(GREY, "double", False)
        base, others = material.base_color, (material.metallic, material.roughness, material.emission)
        if any(value is not None for value in others) or (isinstance(base, Tensor) and base.dim() == 2):
            return None
        color = GREY
        if isinstance(base, Tensor):
            color = tuple(as_bytes(displayed(base.detach().float().reshape(1, 1, -1)))[0, 0].tolist())
        return _Simple(color, "double" if material.two_sided else "front", mesh.normals is None)


def _alike(a: Mesh, b: Mesh) -> bool:
    """Whether both look the same."""
    if a is b:
        return True
    these, others = dict(named_tensors(a)), dict(named_tensors(b))
    return (
        _settings(a) == _settings(b)
        and these.keys() == others.keys()
        and all(torch.equal(tensor, others[name]) for name, tensor in these.items())
    )


def _settings(mesh: Mesh) -> tuple[Any, ...]:
    """What is no tensor."""
    material = mesh.material
    own = mesh.wraps, mesh.filter, mesh.alpha_cutoff
    if material is None:
        return own
    textures = {name: (texture.wraps, texture.filter) for name, texture in material.textures.items()}
    return *own, material.two_sided, material.alpha_mode, textures


def _bounds(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    points = torch.cat([mesh.verts.detach().double() for mesh in frame.scene.meshes])
    if frame.matrix is not None:
        points = points @ frame.matrix[:3, :3].double().T + frame.matrix[:3, 3].double()
    low, high = points.aminmax(dim=0)
    return low.numpy(), high.numpy()


def _floats(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().numpy()


def _thumbnail(target: Tensor) -> np.ndarray:
    every = max(1, max(target.shape[:2]) // THUMBNAIL)
    return as_bytes(displayed(target[::every, ::every].float()))
