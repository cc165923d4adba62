"""Scenes: meshes before a background."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ..check import MOST_ROWS, as_tensor, check_fields, check_finite, check_float, check_shape
from .environment import Environment
from .lights import DirectionalLight, Light, PointLight, SphericalHarmonics, SpotLight
from .material import Material, Texture
from .mesh import Mesh
from .mesh_light import MeshLight
from .state import from_state, to_state
from .tree import map_tensors, moved


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes that hide one another, before a background.

    With a light, or a mesh with a material, the scene is lit: meshes with a material are shaded, those without keep their
    colours for radiance. TypeError and ValueError name a wrong field.

    Parameters
    ----------
    meshes : Mesh or a sequence of Mesh
        All with the same number of channels C.
    background : (C,) or (H, W, C) float, default black
        Linear radiance where nothing is hit. An image is laid behind the pixels: I = Σ samples that hit + (1 − coverage) ·
        background.
    lights : sequence of lights, default none
        Meshes whose materials have emission are lights, too; those among `lights` join the meshes. All have one channel or C.

    Examples
    --------
    >>> import edgegrad as eg
    >>> ball = eg.shapes.sphere(subdivisions=1, material=eg.Material(base_color=0.8))
    >>> scene = eg.Scene([ball], lights=[eg.lights.DirectionalLight((0.0, -1.0, -1.0))])
    >>> scene.is_lit, scene.channels
    (True, 3)
    """

    meshes: Sequence[Mesh]
    background: Tensor | None = None
    lights: Sequence[Light | Mesh] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.meshes, (Mesh, Sequence)):
            raise TypeError(f"meshes: expected a Mesh or a sequence of them, got {type(self.meshes).__name__}")
        meshes = (self.meshes,) if isinstance(self.meshes, Mesh) else tuple(self.meshes)
        meshes = self._check_lights(meshes)
        object.__setattr__(self, "meshes", meshes)
        if not meshes:
            raise ValueError("meshes: expected at least one Mesh, got none")
        for i, mesh in enumerate(meshes):
            if not isinstance(mesh, Mesh):
                raise TypeError(f"meshes[{i}]: expected a Mesh, got {type(mesh).__name__}")
        known = {mesh.channels for mesh in meshes if mesh.channels is not None}
        if len(known) > 1:
            first = next(i for i, m in enumerate(meshes) if m.channels is not None)
            C = meshes[first].channels
            i = next(i for i, m in enumerate(meshes) if m.channels not in (None, C))
            raise ValueError(
                f"meshes[{i}]: expected {C} channels like meshes[{first}], got {meshes[i].channels}; "
                "give all colours and textures the same number of channels"
            )
        for i, light in enumerate(self._lights):
            if light.channels is not None and known and light.channels not in known:
                raise ValueError(
                    f"lights[{i}]: expected {next(iter(known))} channels, or one, like the meshes and lights before it, got "
                    f"{light.channels}; give it a colour for each channel"
                )
            known |= set() if light.channels is None else {light.channels}
        corners = 3 * sum(mesh.faces.shape[0] for mesh in meshes)
        rows = max(
            corners, *(sum(len(t) for m in meshes if (t := getattr(m, n)) is not None) for n in ("verts", "uvs"))
        )
        if rows > MOST_ROWS:
            raise ValueError(
                f"meshes: expected at most {MOST_ROWS} vertices, texture coordinates and corners of faces in all, got {rows}; "
                "render them in parts"
            )
        devices = {mesh.verts.device for mesh in meshes}
        if len(devices) > 1:
            raise ValueError(f"meshes: expected one device, got {sorted(map(str, devices))}; move them with mesh.to(…)")
        if self.background is not None:
            background = as_tensor("background", self.background, like=meshes[0].verts)
            object.__setattr__(self, "background", background)
            C = next(iter(known)) if known else "C"
            check_float("background", background)
            fix = (
                "as many channels as the colours of the meshes; for a shader of others leave these away"
                if known
                else ""
            )
            check_shape("background", background, (C,), ("H", "W", C), fix=fix)
            check_finite("background", background)

    def _check_lights(self, meshes: tuple[Mesh, ...]) -> tuple[Mesh, ...]:
        """Return the meshes, with those among the lights. Raises TypeError or ValueError."""
        given = (self.lights,) if isinstance(self.lights, (Light, Mesh)) else self.lights
        if not isinstance(given, Sequence):
            raise TypeError(f"lights: expected a sequence of lights, got {type(given).__name__}")
        own = []
        for i, light in enumerate(given):
            if isinstance(light, Mesh):
                if light.material is None or light.material.emission is None:
                    raise ValueError(
                        f"lights[{i}]: expected a light, got a Mesh without emission; give it material=eg.Material(emission=…)"
                    )
                if not any(light is mesh for mesh in meshes):  # one that is both counts once
                    meshes = (*meshes, light)
            elif isinstance(light, Light) and not isinstance(light, MeshLight):
                if not dataclasses.is_dataclass(light):
                    raise TypeError(
                        f"lights[{i}]: expected a light whose class is a dataclass, for its fields are what gets gradients, got "
                        f"{type(light).__name__}; write @dataclass(frozen=True, eq=False) above the class"
                    )
                own.append(light)
            else:
                raise TypeError(
                    f"lights[{i}]: expected a light such as eg.lights.PointLight, or a Mesh that emits, got "
                    f"{type(light).__name__}"
                )
        object.__setattr__(self, "lights", tuple(own))
        return meshes

    @property
    def _lights(self) -> tuple[Light, ...]:
        return self.lights  # pyright: ignore[reportReturnType]: those that are meshes joined the meshes

    @property
    def is_lit(self) -> bool:
        """Return whether meshes are shaded: one has a material, or there is a light."""
        return bool(self.lights) or any(mesh.material is not None for mesh in self.meshes)

    @property
    def is_glossy(self) -> bool:
        """Return whether a material scatters otherwise than evenly."""
        return any(mesh.material is not None and mesh.material.is_glossy for mesh in self.meshes)

    @property
    def is_shaded(self) -> bool:
        """Return whether more than the kernel's own colours is visible: light, or mipmaps."""
        return self.is_lit or any(mesh.texture is not None and mesh.filter == "mipmap" for mesh in self.meshes)

    @property
    def textured_faces(self) -> Tensor | None:
        """Return (F,) uint8 on the CPU, the faces whose colours or materials have textures; None where none have."""
        if not any(mesh.has_textures for mesh in self.meshes):
            return None
        return torch.cat([torch.full((len(m.faces),), m.has_textures, dtype=torch.uint8) for m in self.meshes])

    @property
    def blends(self) -> bool:
        """Return whether one sees through a mesh."""
        return any(mesh.blends for mesh in self.meshes)

    @cached_property
    def casting(self) -> tuple[Light, ...]:
        """Return the lights that cast shadows, in a fixed order: those of `lights`, then the meshes that emit."""
        emitting = [m for m in self.meshes if m.material is not None and m.material.emission is not None]
        return (*(light for light in self._lights if light.casts), *map(MeshLight, emitting))

    @property
    def channels(self) -> int:
        """Return the number of channels C; 3 for a plain scene on black."""
        for part in (*self.meshes, *self._lights):
            if part.channels is not None:
                return part.channels
        return 3 if self.background is None else self.background.shape[-1]

    def replace(self, **fields: Any) -> Scene:
        """Return this scene with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def transformed(self, R: Tensor | None = None, t: Tensor | None = None, scale: Tensor | float = 1.0) -> Scene:
        """Return the scene with all meshes and lights moved together; the arguments are those of Mesh.transformed().

        Surfaces stay as bright: the intensities of points and spots, which fall off with distance, grow as areas do. For
        lights from all around R must be a rotation.
        """
        return self.replace(
            meshes=[mesh.transformed(R, t, scale) for mesh in self.meshes],
            lights=[light.transformed(R, t, scale) for light in self._lights],
        )

    def to(self, *args: Any, **kwargs: Any) -> Scene:
        """Return the scene on a device or of a dtype, as `torch.Tensor.to`."""
        return moved(self, *args, **kwargs)

    def detach(self) -> Scene:
        """Return the scene cut from the autograd graph."""
        return map_tensors(self, Tensor.detach)

    def state_dict(self) -> dict[str, Any]:
        """Return the scene as nested dictionaries and lists of tensors, strings and numbers, for torch.save().

        torch.load(…, weights_only=True) reads them. Tensors are detached, and share their memory with the scene's. Raises
        TypeError for a light of a class of one's own.
        """
        return to_state(self, CLASSES)

    @staticmethod
    def from_state_dict(state: dict[str, Any]) -> Scene:
        """Return the scene of a state_dict(), with the same tensors; none requires gradients.

        TypeError and ValueError name missing and unexpected keys.
        """
        return from_state(state, Scene, CLASSES)

    def __repr__(self) -> str:
        back = "black" if self.background is None else f"background {tuple(self.background.shape)}"
        lights = "".join(f", {type(light).__name__}" for light in self.lights)
        return f"Scene({', '.join(map(repr, self.meshes))}; {back}{lights})"


CLASSES = (
    Scene, Mesh, Material, Texture, DirectionalLight, PointLight, SpotLight, SphericalHarmonics, Environment,
)  # fmt: skip


def as_scene(scene: Scene | Mesh) -> Scene:
    """Return a mesh alone as a scene. Raises TypeError."""
    if isinstance(scene, Mesh):
        return Scene([scene])
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a Scene or a Mesh, got {type(scene).__name__}")
    return scene
