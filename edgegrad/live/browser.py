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
from ..fit.views import displayed
from ..optional import require
from ..scene.material import Material
from ..scene.mesh import DEFAULT_RADIANCE, Mesh
from ..scene.tree import named_tensors
from .snapshot import BONE, CONTRAST, Snapshot, as_bytes

WIDTH = 480  # pixels of the panel next to the scene
THUMBNAIL = 128  # pixels on the longer side of a picture in a frustum
FRUSTUM = 0.12  # size of a frustum, as a part of the distance from the cameras to the meshes
MAX_FOV, NOMINAL_FOV = 2.0, 0.6  # radians of a frustum: the largest, and that of a camera without field of view
AMBIENT = 1.5
FOV, MIN_ANGLE = 0.8, 0.9  # radians: field of view of the page's camera, and angle between it and the cameras shown
BODY_OPACITY = 0.6  # of a mesh around its bones
MAX_POINTS = 500  # of the curve
GREY = (round(255 * (1.055 * DEFAULT_RADIANCE ** (1 / 2.4) - 0.055)),) * 3  # sRGB
PANEL_TITLE = f"target | render | difference × {CONTRAST}"


class Controls(NamedTuple):
    """Functions that the page's buttons call, from threads of the server."""

    pause: Callable[[], None]
    stop: Callable[[], None]
    select_camera: Callable[[int], None]  # through another camera


class _DrawnMesh(NamedTuple):
    """A mesh as it was last drawn."""

    mesh: Mesh
    handle: Any  # viser's


class Browser:
    """The page of a live view. Raises ImportError without viser, OSError if the host has no free port."""

    def __init__(self, host: str, port: int, controls: Controls) -> None:
        viser = require("viser", "edgegrad[view]", "the live view")
        with _quiet():
            self.server: Any = viser.ViserServer(host, port, verbose=False)
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "") else host
        self.url = f"http://{shown}:{self.server.get_port()}"
        self._rotation = viser.transforms.SO3.from_matrix
        self._meshes: dict[int, _DrawnMesh] = {}
        self._frusta: list[tuple[Tensor | None, Any]] = []
        self._bones: Any = None
        # Colours may be radiance, with their light in them. An even light, added to the page's own, shows them and the shape.
        self.server.scene.configure_default_lights(cast_shadow=False)
        self.server.scene.add_light_ambient("/light", intensity=AMBIENT)
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)  # sharing would open the page to everyone
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
        self.view.on_update(lambda event: controls.select_camera(int(event.target.value) - 1))

    def draw(self, snapshot: Snapshot, index: int, losses: Sequence[float], state: str) -> None:
        first = not self._meshes
        if first:
            self._place_initial_camera(snapshot)
        with self.server.atomic():
            self._draw_meshes(snapshot)
            self._draw_bones(snapshot)
            self._draw_cameras(snapshot)
        self.draw_panel(snapshot, index)
        self.set_status(state)
        self._draw_curve(losses)

    def draw_panel(self, snapshot: Snapshot, index: int) -> None:
        if not snapshot.cameras:
            return
        picture = np.concatenate(snapshot.panel(index), axis=1)
        if self.picture is None:
            self.picture = self.server.gui.add_image(picture, label=PANEL_TITLE, order=self.view.order + 0.1)
        self.picture.image = picture

    def set_status(self, state: str) -> None:
        self.status.content = state

    def set_labels(self, pause: str, stop: str) -> None:
        self.pause.label, self.stop.label = pause, stop

    def close(self) -> None:
        with _quiet():
            self.server.stop()

    # -- the scene --------------------------------------------------------------------------------------------------------

    def _place_initial_camera(self, snapshot: Snapshot) -> None:
        """Place the page's camera beyond the cameras and between them, so that they do not hide the meshes."""
        low, high = _bounds(snapshot)
        center, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        up, away = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.3, 1.0])
        distance = size
        if snapshot.cameras:
            poses = [camera.world_to_camera.detach().double().numpy() for camera in snapshot.cameras]
            mean = -np.mean([pose[1, :3] for pose in poses], axis=0)
            up = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 0.1 else -poses[0][1, :3]
            offsets = np.stack([camera.eye.detach().double().numpy() for camera in snapshot.cameras]) - center
            lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
            distance = max(float(lengths.max()), 0.5 * size)
            away = 1.4 * _direction_apart(offsets / (lengths + 1e-30), up)
            center = center + 0.4 * offsets.mean(0)  # so that both are in the picture
        self.distance = distance
        self.server.scene.set_up_direction(tuple(up))
        start = self.server.initial_camera
        start.near, start.far = 1e-3 * distance, 1e3 * distance
        places = [start, *(client.camera for client in self.server.get_clients().values())]
        for camera in places:  # pages that were opened before the first step look there too
            camera.position, camera.look_at = center + distance * away, center
            camera.fov = FOV

    def _draw_meshes(self, snapshot: Snapshot) -> None:
        place: dict[str, Any] = {}
        if snapshot.matrix is not None:
            M = snapshot.matrix.detach().double().numpy()
            scale = float(np.cbrt(np.linalg.det(M[:3, :3])))
            place = {"wxyz": self._rotation(M[:3, :3] / scale).wxyz, "position": M[:3, 3], "scale": scale}
        for i, mesh in enumerate(snapshot.scene.meshes):
            old = self._meshes.get(i)
            if old is None or not _same_appearance(old.mesh, mesh):
                style = _Style.from_mesh(mesh)
                same = old is not None and style is not None and style == _Style.from_mesh(old.mesh)
                if old and same and torch.equal(old.mesh.faces, mesh.faces):
                    handle = old.handle
                    handle.vertices = _floats(mesh.verts)
                else:
                    handle = self._added(f"/meshes/{i}", mesh, 1.0 if snapshot.bones is None else BODY_OPACITY)
                self._meshes[i] = _DrawnMesh(mesh, handle)
            for name, value in place.items():
                setattr(self._meshes[i].handle, name, value)

    def _added(self, name: str, mesh: Mesh, opacity: float) -> Any:
        """Add a mesh, in place of one of that name."""
        if (style := _Style.from_mesh(mesh)) is not None:
            faces = mesh.faces.numpy().astype(np.uint32)
            transparency = {"opacity": opacity} if opacity < 1.0 else {}
            return self.server.scene.add_mesh_simple(
                name, _floats(mesh.verts), faces, **style._asdict(), **transparency
            )
        mesh = mesh.detach()
        if mesh.face_colors is not None:  # colours of corners are written faster
            mesh = mesh.replace(corner_colors=mesh.face_colors[:, None].expand(-1, 3, -1))
        if mesh.material is None:  # a matt and smooth one
            mesh = mesh.replace(material=Material(), normals=mesh.vertex_normals(), normal_faces=None)
        if opacity < 1.0 and mesh.alpha is None and mesh.material is not None:
            own = mesh.uvs is not None
            anywhere = {} if own else {"uvs": torch.zeros(1, 2), "uv_faces": torch.zeros_like(mesh.faces)}
            blends = mesh.material.replace(alpha_mode="BLEND")
            mesh = mesh.replace(alpha=torch.full((1, 1), opacity), material=blends, **anywhere)
        return self.server.scene.add_glb(name, to_glb(mesh)[0])

    def _draw_bones(self, snapshot: Snapshot) -> None:
        if snapshot.bones is None:
            return
        points = snapshot.bones.detach().float().numpy()
        if self._bones is None or len(self._bones.points) != len(points):
            color = tuple(round(255 * value) for value in BONE)
            self._bones = self.server.scene.add_line_segments(
                "/bones", points, color, thickness=3.0, thickness_units="screen"
            )
        self._bones.points = points

    def _draw_cameras(self, snapshot: Snapshot) -> None:
        if len(snapshot.cameras) != len(self._frusta):
            for _, handle in self._frusta:
                handle.remove()
            self._frusta = [(None, self._frustum(i, camera)) for i, camera in enumerate(snapshot.cameras)]
            if len(snapshot.cameras) > 1:
                self.view.options = [str(i + 1) for i in range(len(snapshot.cameras))]
            self.view.visible = len(snapshot.cameras) > 1
        for i, (camera, target) in enumerate(zip(snapshot.cameras, snapshot.targets, strict=True)):
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
        fov = NOMINAL_FOV
        if camera.projection != "orthographic":
            fov = min(MAX_FOV, math.radians(abs(float(camera.fov_y.detach()))))
        aspect = W * abs(float(K[1, 1])) / (H * abs(float(K[0, 0])))
        position = camera.eye.detach().double().numpy()
        return {"wxyz": self._rotation(R.T).wxyz, "position": position, "fov": fov, "aspect": aspect}

    # -- the panel --------------------------------------------------------------------------------------------------------

    def _draw_curve(self, losses: Sequence[float]) -> None:
        every = max(1, math.ceil(len(losses) / MAX_POINTS))
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
    """Suppress the banner that viser prints through rich."""
    console = require("rich", "edgegrad[view]", "the live view").get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _direction_apart(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the direction nearest to the first of several that is MIN_ANGLE away from all, or as far as possible; from above."""
    e = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    e /= np.linalg.norm(e)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 5)), np.radians([15, 30, 45, 60]))
    flat = np.cos(azimuth)[..., None] * e + np.sin(azimuth)[..., None] * np.cross(up, e)
    candidates = (np.cos(elevation)[..., None] * flat + np.sin(elevation)[..., None] * up).reshape(-1, 3)
    cosines = candidates @ directions.T
    nearest = np.maximum(cosines.max(1), np.cos(MIN_ANGLE))
    return candidates[np.argmin(nearest - 1e-3 * cosines[:, 0])]


class _Style(NamedTuple):
    """The appearance of a mesh of one matt colour. When it moves, only its vertices are sent."""

    color: tuple[int, ...]  # sRGB
    side: str
    flat_shading: bool

    @staticmethod
    def from_mesh(mesh: Mesh) -> _Style | None:
        """Return None for a mesh that needs more. Colours of other than 1 or 3 channels cannot be shown."""
        material = mesh.material
        if mesh.channels not in (None, 1, 3):
            return _Style(GREY, "double", False)
        colorless = mesh.colors is mesh.face_colors is mesh.corner_colors is None
        if mesh.alpha is not None or mesh.has_textures or not colorless:
            return None
        if material is None:
            return _Style(GREY, "double", False)
        base, others = material.base_color, (material.metallic, material.roughness, material.emission)
        if any(value is not None for value in others) or (isinstance(base, Tensor) and base.dim() == 2):
            return None
        color = GREY
        if isinstance(base, Tensor):
            color = tuple(as_bytes(displayed(base.detach().float().reshape(1, 1, -1)))[0, 0].tolist())
        return _Style(color, "double" if material.two_sided else "front", mesh.normals is None)


def _same_appearance(a: Mesh, b: Mesh) -> bool:
    """Return whether both meshes are drawn the same."""
    if a is b:
        return True
    these, others = dict(named_tensors(a)), dict(named_tensors(b))
    return (
        _settings(a) == _settings(b)
        and these.keys() == others.keys()
        and all(torch.equal(tensor, others[name]) for name, tensor in these.items())
    )


def _settings(mesh: Mesh) -> tuple[Any, ...]:
    """Return what is no tensor."""
    material = mesh.material
    own = mesh.wraps, mesh.filter, mesh.alpha_cutoff
    if material is None:
        return own
    textures = {name: (texture.wraps, texture.filter) for name, texture in material.textures.items()}
    return *own, material.two_sided, material.alpha_mode, textures


def _bounds(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    points = torch.cat([mesh.verts.detach().double() for mesh in snapshot.scene.meshes])
    if snapshot.matrix is not None:
        points = points @ snapshot.matrix[:3, :3].double().T + snapshot.matrix[:3, 3].double()
    low, high = points.aminmax(dim=0)
    return low.numpy(), high.numpy()


def _floats(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().numpy()


def _thumbnail(target: Tensor) -> np.ndarray:
    every = max(1, max(target.shape[:2]) // THUMBNAIL)
    return as_bytes(displayed(target[::every, ::every].float()))
