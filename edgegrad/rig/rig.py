"""A rig: a differentiable function from few numbers to meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from ..check import as_tensor
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .animation import Animation
from .control import Control, batch_of
from .function import FunctionDeformer
from .joints import Joints
from .rotations import one_as_matrix
from .skin import Skin
from .skinned import SkinDeformer

Deformed = tuple[list[Tensor], list[Tensor | None], Tensor | None]  # verts and normals of each mesh, joints; see Shape


class Deformer(Protocol):
    """An object that bends the meshes of a rig."""

    @property
    def controls(self) -> Mapping[str, Control]: ...

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of its joints."""
        ...

    @property
    def parents(self) -> tuple[int, ...]:
        """Return the parents of its joints, −1 of none."""
        ...

    def with_controls(self, controls: Mapping[str, Control]) -> Deformer: ...

    def __call__(self, values: Mapping[str, Tensor], meshes: Sequence[Mesh]) -> Deformed:
        """Return vertices, normals and joints. Values are float64, of rotations matrices; some, and what depends on them, may
        have a batch in front."""
        ...


class Shape(NamedTuple):
    """A rig in one pose, or in each of a batch."""

    verts: list[Tensor]  # (…, V, 3) of each mesh
    normals: list[Tensor | None]  # (…, N, 3)
    joints: Tensor | None  # (…, J, 3) where they are, float64


@dataclass(frozen=True, eq=False)
class Rig:
    """Meshes that bend: a differentiable function from few numbers to vertices.

    It is made by eg.rig.load(path), Rig.from_arrays(…) or Rig.from_function(…).

    Attributes
    ----------
    scene : Mesh or Scene
        The meshes at rest, with their appearance.
    controls : mapping of names to Control
        The numbers that move it: their values at rest, limits and names of rows. A skinned rig has "rotations",
        "joint_translations", "joint_scales" and "morphs"; a robot has "angles"; a function has its own.
    animations : mapping of names to Animation
    joints : Joints
        Of a skinned rig, at rest.
    """

    scene: Scene | Mesh
    deformer: Deformer = field(repr=False)
    animations: Mapping[str, Animation] = field(default_factory=dict)
    center: Tensor = field(init=False, repr=False)  # (3,) float64, of the bounding box at rest
    size: float = field(init=False, repr=False)  # its diagonal

    def __post_init__(self) -> None:
        with torch.no_grad():
            verts, _, _ = self._bent({}, {})
        verts = torch.cat([v.double() for v in verts])
        low, high = verts.aminmax(dim=0)
        object.__setattr__(self, "center", 0.5 * (low + high))
        object.__setattr__(self, "size", float((high - low).norm()))

    @property
    def controls(self) -> Mapping[str, Control]:
        return self.deformer.controls

    @property
    def joints(self) -> Joints | None:
        return getattr(self.deformer, "joints", None)

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        return (self.scene,) if isinstance(self.scene, Mesh) else tuple(self.scene.meshes)

    def __repr__(self) -> str:
        controls = ", ".join(f"{name} {tuple(c.rest.shape)}" for name, c in self.controls.items())
        return f"Rig({len(self.meshes)} meshes, {controls}, animations: {', '.join(self.animations) or 'none'})"

    # -- poses --------------------------------------------------------------------------------------------------------------

    def posed(
        self,
        rotations: Tensor | Mapping[str, Any] | None = None,
        *,
        translation: Tensor | None = None,
        scale: Tensor | float | None = None,
        orientation: Tensor | None = None,
        skinning: str | None = None,
        **values: Any,
    ) -> Any:
        """Return the meshes in a pose: a Mesh or a Scene, as the rig's; of a batch a list of these. Arguments that are not
        given are at rest.

        It is differentiable by all of them. Each may have one more dimension in front, the poses of a batch. Limits are not
        applied: see clamped(). Raises TypeError or ValueError that names the argument, ImportError without roma.

        Parameters
        ----------
        rotations : (J, 3) rotation vectors in radians, (J, 4) unit quaternions x, y, z, w or (J, 3, 3) matrices, or a mapping
        of some by the joint's name
            Rotations of each joint about its own axes, from rest, where all are the identity.
        morphs : (M,), or a mapping by name
            Weights of morph targets.
        joint_translations, joint_scales : (J, 3)
            Of joints within their parents, in place of those at rest; scales are along the joint's own axes.
        translation, orientation, scale : (3,); (3,), (4,) or a matrix (3, 3); float
            Then the whole is turned and scaled about the middle of its box at rest, `center`, and moved.
        skinning : "linear" or "dual quaternion", default "linear"
            The latter keeps volume where joints twist.
        **values
            Of other rigs: those of their controls, as `angles` of a robot.
        """
        given = {**values, **({} if rotations is None else {"rotations": rotations})}
        for name in given:
            self._control("posed", name)
        settings = {} if skinning is None else {"skinning": skinning}
        shape = self.shape(given, translation=translation, scale=scale, orientation=orientation, **settings)
        if shape.verts[0].dim() == 2:
            return self._scene(shape.verts, shape.normals)
        return [
            self._scene([v[k] for v in shape.verts], [None if n is None else n[k] for n in shape.normals])
            for k in range(len(shape.verts[0]))
        ]

    def shape(
        self,
        values: Mapping[str, Any],
        *,
        translation: object = None,
        scale: object = None,
        orientation: object = None,
        **settings: Any,
    ) -> Shape:
        """Return vertices, normals and joints of what posed() makes, as tensors, of values by the names of controls."""
        known = {
            name: self._control("shape", name).value(name, value) for name, value in values.items() if value is not None
        }
        f64 = torch.float64
        whole = {
            "translation": Control(torch.zeros(3, dtype=f64)).value("translation", translation),
            "scale": Control(torch.ones((), dtype=f64)).value("scale", scale),
            "orientation": _turn(orientation),
        }
        dims = {name: self.controls[name].rest.dim() + self.controls[name].rotates for name in known}
        dims |= {"translation": 1, "scale": 0, "orientation": 2}
        every = {**known, **whole}
        batch = batch_of([(name, value, dims[name]) for name, value in every.items()])
        verts, of_meshes, joints = self._bent(known, settings)
        t, s, R = whole["translation"], whole["scale"], whole["orientation"]

        moves = any(value is not None for value in (translation, scale, orientation))

        def placed(points: Tensor, dtype: torch.dtype) -> Tensor:
            if moves:
                linear = s[..., None, None] * R
                shift = self.center + t - (linear @ self.center[:, None])[..., 0]
                points = points @ linear.mT.to(dtype) + shift[..., None, :].to(dtype)
            return points if batch is None else points.expand(batch, *points.shape[-2:])

        normals = [None if n is None else (n @ R.mT.to(n) if orientation is not None else n) for n in of_meshes]
        return Shape(
            [placed(v, v.dtype) for v in verts],
            [None if n is None else n if batch is None else n.expand(batch, *n.shape[-2:]) for n in normals],
            None if joints is None else placed(joints, f64),
        )

    def _bent(self, values: Mapping[str, Tensor], settings: Mapping[str, Any]) -> Deformed:
        return self.deformer(values, self.meshes, **settings)

    def _scene(self, verts: list[Tensor], normals: list[Tensor | None]) -> Scene | Mesh:
        meshes = [
            mesh.replace(verts=v) if n is None else mesh.replace(verts=v, normals=n)
            for mesh, v, n in zip(self.meshes, verts, normals, strict=True)
        ]
        return meshes[0] if isinstance(self.scene, Mesh) else self.scene.replace(meshes=meshes)

    def _control(self, asked: str, name: str) -> Control:
        if name not in self.controls:
            place = ", or translation, scale and orientation" if asked == "posed" else ""
            raise TypeError(f"{asked}: expected values of {', '.join(self.controls)}{place}, got {name!r}")
        return self.controls[name]

    def bones(self, values: Mapping[str, Any]) -> Tensor | None:
        """Return the bones (K, 2, 3) float64, from the parent of each joint that has one to the joint, of all values that
        posed() takes.

        None is returned where the rig has no such joints.
        """
        own = {name: value for name, value in values.items() if name in self.controls}
        joints = self.shape(own, **{name: value for name, value in values.items() if name not in own}).joints
        pairs = [(parent, k) for k, parent in enumerate(self.deformer.parents) if parent >= 0]
        return joints[torch.tensor(pairs)] if joints is not None and pairs else None

    # -- limits -------------------------------------------------------------------------------------------------------------

    def with_limits(self, **limits: Any) -> Rig:
        """Return the rig with limits for controls: a pair of low and high that broadcast, or such pairs by the names of rows.

            rig.with_limits(rotations={"elbow": ([0, 0, 0], [0, 0, 2.4])}, morphs=(0.0, 1.0))

        Fits keep them, clamped() applies them. Raises TypeError or ValueError.
        """
        controls = dict(self.controls)
        for name, given in limits.items():
            control = self._control("with_limits", name)
            if isinstance(given, Mapping):
                low = torch.full_like(control.rest, -torch.inf) if control.low is None else control.low.clone()
                high = torch.full_like(control.rest, torch.inf) if control.high is None else control.high.clone()
                for key, pair in given.items():
                    k = control.row(name, key)
                    own = Control(control.rest[k]).limited(f"{name}[{key!r}]", *_pair(f"{name}[{key!r}]", pair))
                    low[k] = low[k] if own.low is None else own.low
                    high[k] = high[k] if own.high is None else own.high
                controls[name] = control.limited(name, low, high)
            else:
                controls[name] = control.limited(name, *_pair(name, given))
        return replace(self, deformer=self.deformer.with_controls(controls))

    def clamped(self, **values: Any) -> dict[str, Tensor]:
        """Return values of controls within their limits; rotations become rotation vectors. Raises TypeError or ValueError."""
        from .rotations import roma

        found = {}
        for name, given in values.items():
            control = self._control("clamped", name)
            value = control.value(name, given)
            found[name] = control.within(roma().rotmat_to_rotvec(value) if control.rotates else value)
        return found

    def animation(self, name: str | int = 0) -> Animation:
        """Return an animation by name or place: rig.posed(**rig.animation("Walk").at(0.5)). Raises ValueError."""
        names = list(self.animations)
        if isinstance(name, int) and not isinstance(name, bool) and -len(names) <= name < len(names):
            name = names[name]
        if name not in self.animations:
            raise ValueError(f"name: expected an animation among {', '.join(names) or 'none'}, got {name!r}")
        return self.animations[str(name)]

    # -- made of ------------------------------------------------------------------------------------------------------------

    @staticmethod
    def from_arrays(
        mesh: Mesh | Scene,
        joints: Joints,
        skins: Skin | Sequence[Skin] | Tensor,
        *,
        morphs: Mapping[str, float] | Sequence[str] = (),
        animations: Sequence[Animation] = (),
    ) -> Rig:
        """Return a skinned rig. Raises TypeError or ValueError that names the argument.

        Parameters
        ----------
        mesh : Mesh or Scene
            At rest.
        joints : Joints
            Their hierarchy at rest.
        skins : Skin, a sequence of Skin, or (V, J)
            How each mesh is bound to the joints; or weights of one mesh that is bound as it stands at rest.
        morphs : sequence of names, or mapping of names to weights
            The morph targets that the skins hold, with their weights at rest, 0 by default.
        animations : sequence of Animation
            Of these joints.
        """
        meshes = [mesh] if isinstance(mesh, Mesh) else list(mesh.meshes)
        if isinstance(skins, Tensor):
            inverse = torch.linalg.inv(joints.world())
            skins = [Skin(torch.arange(len(joints)), inverse, skins)]
        skins = [skins] if isinstance(skins, Skin) else list(skins)
        if len(skins) != len(meshes):
            raise ValueError(f"skins: expected one for each of {len(meshes)} meshes, got {len(skins)}")
        named = dict(morphs) if isinstance(morphs, Mapping) else dict.fromkeys(morphs, 0.0)
        checked = []
        for k, (skin, one) in enumerate(zip(skins, meshes, strict=True)):
            checked.append(skin.checked(f"skins[{k}]", len(joints), one.verts, one.normals))
            last = skin.morphs + (0 if skin.targets is None else len(skin.targets))
            if last > len(named):
                raise ValueError(f"morphs: expected names for {last} morph targets of skins[{k}], got {len(named)}")
        weights = torch.tensor(list(named.values()), dtype=torch.float64)
        made = SkinDeformer.from_skins(joints, tuple(checked), tuple(named), weights)
        return Rig(mesh, made, {animation.name: animation for animation in animations})

    @staticmethod
    def from_function(
        function: Callable[..., Any],
        faces: Tensor | Mesh | Scene,
        controls: Mapping[str, Tensor | Control],
        *,
        batched: bool = False,
        joints: Sequence[tuple[str, int]] = (),
    ) -> Rig:
        """Return a rig of any function from numbers to vertices, such as a body model. Raises TypeError or ValueError that
        names the argument.

            model = anny.Anny(skinning_method="lbs")
            rig = eg.rig.Rig.from_function(body, model.get_triangular_faces(), {"age": torch.tensor(0.5), …})

        Parameters
        ----------
        function : callable
            It is given the controls by name and returns vertices (V, 3), or those of each mesh of a Scene; or a dict of these
            as "verts", with "joints" (J, 3) where keypoints are to be fitted. It must be differentiable by PyTorch.
        faces : (F, 3), Mesh or Scene
            A Mesh or Scene also has the appearance of what is bent.
        controls : mapping of the function's arguments
            Values at rest; or Controls, with limits and names.
        batched : bool, default False
            Whether the function takes and returns a batch: then it is always given one, (B, …).
        joints : sequence of (name, place of its parent, −1 of none)
        """
        if not callable(function):
            raise TypeError(f"function: expected a function, got {type(function).__name__}")
        if not isinstance(controls, Mapping) or not controls:
            raise TypeError(
                "controls: expected a mapping of names to values at rest, got none; give what moves the vertices"
            )
        made = FunctionDeformer.from_arguments(function, controls, batched, joints)
        if not isinstance(faces, Mesh | Scene):
            with torch.no_grad():
                verts = made.at_rest()
            if len(verts) != 1:
                raise ValueError(f"faces: expected a Scene for {len(verts)} meshes, got one tensor")
            index = as_tensor("faces", faces)
            faces = Mesh(verts[0] if verts[0].dtype == torch.float64 else verts[0].float(), index)
        return Rig(faces, made)


def _turn(given: object) -> Tensor:
    """Return matrices (…, 3, 3) of what posed() takes as orientation."""
    eye = torch.eye(3, dtype=torch.float64)
    return eye if given is None else one_as_matrix("orientation", as_tensor("orientation", given, like=eye).double())


def _pair(name: str, given: object) -> tuple[object, object]:
    if not isinstance(given, tuple) or len(given) != 2:
        raise TypeError(f"{name}: expected a pair (low, high), got {given!r}")
    return given[0], given[1]
