"""Hits: the points of surfaces that a shader written in PyTorch is given, and what it may ask of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..check import as_tensor, check_finite, check_float, check_int, check_positive_int, check_shape, values_visible
from ..scene.lights import Light, LightPoints
from ..scene.material import WRAPS
from ..scene.mesh import FILTERS
from ..scene.rows import interpolated, rows_of
from ..scene.textures import bilinear, in_texels, nearest
from .discontinuities import Discontinuities, DiscontinuitiesOfSubset
from .footprints import Footprints, level, pyramid_of
from .records import RayRecords, visible
from .seeds import uniform
from .shadow_rays import Forced, seen_from
from .sobol import key_of, sobol
from .surfaces import CameraView, Rays, Surfaces, every_face

LightSampler = Callable[["Hits", Light, int], list[LightPoints]]  # so many points of a light for each of the hits


class Hits:
    """N points of surfaces as a shader sees them.

    Where the renderer differentiates a shader, properties are differentiable functions of the vertices and the camera at fixed
    places in the image; elsewhere they have no derivatives. A shader must be a function of each point by itself.

    render() makes hits for its shader, trace() for any rays, primary_hits() for those of an image. A property is computed when
    it is first asked for, and kept. If you use torch.utils.checkpoint in a shader, ask for the properties before it.
    """

    # What has an underscore is between the renderer and its own shader of lit scenes (edgegrad/light).

    def __init__(
        self,
        surfaces: Surfaces,
        view: CameraView | Rays,
        face: Tensor,
        barycentrics: Tensor,  # (N, 3) float64
        pixel: Tensor | None = None,  # (N, 2)
        rays_at: Callable[[Tensor], RayRecords] | None = None,  # those of the camera
        discontinuities: Discontinuities | None = None,
        seed: Tensor | None = None,  # (N,) int64, of random()
        forced: Forced | None = None,
    ) -> None:
        self._surfaces, self._view, self._rays_at = surfaces, view, rays_at
        self._needs_values = True  # False: radiance may be zeros that have its derivatives (light/in_kernel.py)
        self._on_curve = False  # whether it is asked how radiance jumps there
        self._near = 0.0  # world units: light from nearer has no derivatives by where these lie (light/near_field.py)
        self._seed = torch.arange(len(face), device=face.device) if seed is None else seed
        self._forced = forced
        self._face, self._exact = face, barycentrics
        self._barycentrics = barycentrics.to(surfaces.verts.dtype)
        self._pixel, self._discontinuities = pixel, discontinuities or Discontinuities()
        self._all: tuple[Hits, Tensor] | None = None  # the hits that these are a subset of, and their rows there
        self._drawn: dict[
            tuple[LightSampler, int, int], list[LightPoints]
        ] = {}  # by a sampler, of a light and so many samples
        # What visible_from() found, by the light's place in scene.casting: (N,) int8, −1 where it was not asked.
        self._lit: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._face)

    def __repr__(self) -> str:
        return f"Hits({len(self)} points)"

    def select(self, index: Tensor) -> Hits:
        """Return some of the points, or all in another order: `index` (M,) of integers, each once, or a mask (N,).
        Discontinuities that where() and floor() declare of them are those of the whole. Raises TypeError or ValueError that
        names the argument."""
        index = as_tensor("index", index).to(self._face.device)
        count = len(self)
        if index.dtype == torch.bool:
            check_shape("index", index, (count,), fix="a mask has a value for each point")
            index = index.nonzero()[:, 0]
        if index.is_floating_point() or index.is_complex():
            raise TypeError(f"index: expected integers or a mask, got {index.dtype}")
        check_shape("index", index, (len(index) if index.dim() == 1 else "M",))
        index = index.long()
        wrong = (index < -count) | (index >= count)
        if values_visible(index) and bool(wrong.any()):
            raise ValueError(f"index: expected numbers from {-count} to {count - 1}, got {int(index[wrong][0])}")
        return self._subset(index, DiscontinuitiesOfSubset(self._discontinuities, index % max(count, 1), count))

    def _subset(self, index: Tensor | slice, discontinuities: Discontinuities | None = None) -> Hits:
        """Return some of the points, with discontinuities of their own, while select() passes them on to the whole."""
        view = self._view.select(index) if isinstance(self._view, Rays) else self._view
        pixel = None if self._pixel is None else self._pixel[index]
        forced = None if self._forced is None else self._forced.select(index)
        place = self._face[index], self._exact[index], pixel
        some = Hits(self._surfaces, view, *place, self._rays_at, discontinuities, self._seed[index], forced)
        some._needs_values, some._on_curve = self._needs_values, self._on_curve
        some._near = self._near
        if self._all is None:
            rows = torch.arange(len(self), device=self._face.device)[index] if isinstance(index, slice) else index
            some._all = self, rows
        else:
            some._all = self._all[0], self._all[1][index]
        return some

    @property
    def pixel(self) -> Tensor:
        """(N, 2) where in the image, px: x right, y down."""
        if self._pixel is None:
            raise ValueError("hits.pixel: expected hits of a camera, these are of rays; see hits.ray")
        return self._pixel.to(self._surfaces.verts.dtype)

    @property
    def ray(self) -> Tensor:
        """(N,) int64: of hits that trace() found, the row of the ray."""
        if not isinstance(self._view, Rays):
            raise ValueError("hits.ray: expected hits of trace(), these are of a camera; see hits.pixel")
        return self._view.ray

    def _note_jump(self, key: Any, corners: Callable[[], Tensor]) -> None:
        """Radiance depends on these values at the corners of faces (F, 3, K): an edge on whose two sides they differ may be a
        crease."""
        self._surfaces.jumping.setdefault(key, corners)

    def _note_faces(self) -> None:
        s = self._surfaces
        self._note_jump("face", lambda: every_face(len(s.faces)).to(s.verts.device))

    @property
    def face(self) -> Tensor:
        """(N,) int64: the face, as the scene counts them, mesh after mesh."""
        self._note_faces()
        return self._face

    @property
    def mesh(self) -> Tensor:
        """(N,) int64: the mesh of the scene."""
        s = self._surfaces
        self._note_jump("mesh", lambda: s.mesh_of_face[:, None, None].expand(-1, 3, 1))
        return s.mesh_of_face[self._face]

    @property
    def barycentrics(self) -> Tensor:
        """(N, 3): the weights of the corners of the face."""
        self._note_faces()
        return self._barycentrics

    @cached_property
    def position(self) -> Tensor:
        """(N, 3) in world coordinates."""
        s = self._surfaces
        return interpolated(self._barycentrics, s.corners(self._face))

    @cached_property
    def depth(self) -> Tensor:
        """(N,) along the camera's axis, world units; of trace(), along the ray, in lengths of its direction."""
        return self._view.depth(self.position).to(self.position.dtype)

    @cached_property
    def normal(self) -> Tensor:
        """(N, 3) unit normal of the face, on the side from which its vertices run counter-clockwise."""
        s = self._surfaces
        every = torch.arange(len(s.faces), device=s.verts.device)
        self._note_jump("normal", lambda: s.face_normals(every)[:, None].expand(-1, 3, -1))
        return s.face_normals(self._face)

    @cached_property
    def shading_normal(self) -> Tensor:
        """(N, 3) unit normal, interpolated between the vertices' normals: means of the faces' normals, weighted by area."""
        s = self._surfaces
        self._note_jump("shading_normal", lambda: s.vertex_normals[s.faces])
        normals = rows_of(s.vertex_normals, rows_of(s.faces, self._face))
        return normalize(interpolated(self._barycentrics, normals), dim=-1)

    @cached_property
    def uv(self) -> Tensor:
        """(N, 2) texture coordinates, v running up."""
        s = self._surfaces
        self._note_jump("uv", lambda: s.corner_uvs)
        return interpolated(self._barycentrics, rows_of(s.corner_uvs, self._face))

    @cached_property
    def view(self) -> Tensor:
        """(N, 3) unit direction to the eye, or back along the ray."""
        return self._view.to_viewer(self.position).to(self.position.dtype)

    def interpolate(self, attribute: Tensor, per: str | None = None) -> Tensor:
        """Return an attribute (N, K) of the scene's vertices (V, K), faces (F, K) or corners of faces (F, 3, K).

        per   "vertex", "face" or "corner", where the shape does not say

        Raises TypeError or ValueError that names the argument.
        """
        s = self._surfaces
        V, F = len(s.verts), len(s.faces)
        attribute = as_tensor("attribute", attribute, floating=True)
        check_float("attribute", attribute)
        check_shape("attribute", attribute, (V, "K"), (F, "K"), (F, 3, "K"))
        if per is None:
            per = "corner" if attribute.dim() == 3 else "vertex" if attribute.shape[0] == V else "face"
            if V == F and attribute.dim() == 2:
                raise ValueError(f'per: expected "vertex" or "face", for the scene has {V} of each; say which')
        rows = {"vertex": (V, 2), "face": (F, 2), "corner": (F, 3)}
        if per not in rows:
            raise ValueError(f'per: expected "vertex", "face" or "corner", got {per!r}')
        if (attribute.shape[0], attribute.dim()) != rows[per]:
            raise ValueError(f"attribute: expected one row a {per}, got shape {tuple(attribute.shape)}")

        def corners() -> Tensor:
            return (
                attribute[s.faces]
                if per == "vertex"
                else attribute
                if per == "corner"
                else attribute[:, None].expand(-1, 3, -1)
            )

        self._note_jump(("attribute", id(attribute)), corners)
        if per == "face":
            return rows_of(attribute, self._face)
        values = rows_of(attribute, rows_of(s.faces, self._face) if per == "vertex" else self._face)
        return interpolated(self._barycentrics.to(values.dtype), values)

    def sample(
        self,
        texture: Tensor,
        uv: Tensor | None = None,
        wrap: str | tuple[str, str] = "repeat",
        mipmap: bool = False,
        filter: str = "linear",
    ) -> Tensor:
        """Return values (N, K) of a texture (h, w, K), row 0 on top, at texture coordinates uv (N, 2), v running up; those of the
        surface when None.

        wrap     beyond the border: "repeat", "clamp" or "mirror", or two of these, for u and for v
        filter   "linear" between the centres of texels; "nearest", the texel itself, whose edges are discontinuities: see where()
        mipmap   True: texels are averaged over squares of 2, 4, 8 … so that neighbouring pixels are about a texel apart, linear
                 between two such levels (Williams 1983). Only for hits of a camera

        Raises TypeError or ValueError that names the argument.
        """
        texture = as_tensor("texture", texture, floating=True)
        check_float("texture", texture)
        check_shape("texture", texture, ("h", "w", "K"))
        wraps = (wrap, wrap) if isinstance(wrap, str) or not isinstance(wrap, Sequence) else tuple(wrap)
        if len(wraps) != 2 or any(w not in WRAPS for w in wraps):
            raise ValueError(f'wrap: expected "repeat", "clamp" or "mirror", or two of these, got {wrap!r}')
        if filter not in FILTERS:
            raise ValueError(f'filter: expected "linear" or "nearest", got {filter!r}')
        if mipmap and filter == "nearest":
            raise ValueError('mipmap: expected filter="linear" with it, got "nearest"')
        kind = "mipmap" if mipmap else filter
        if uv is None:
            corners = self._surfaces.corner_uvs[self._face] if mipmap else None
            return self._look_up(texture, self.uv, wraps, kind, corners)
        uv = as_tensor("uv", uv, floating=True)
        check_shape("uv", uv, (len(self), 2))
        if mipmap:
            raise ValueError(
                "mipmap: expected the surface's own texture coordinates, for how others change from pixel to pixel is not "
                "known; leave uv out, or mipmap"
            )
        return self._look_up(texture, uv, wraps, kind, None)

    def _look_up(
        self, texture: Tensor, uv: Tensor, wraps: tuple[str, ...], filter: str, corners: Tensor | None
    ) -> Tensor:
        """Return values (N, K) of a texture, with "linear", "nearest" or "mipmap", for which `corners` (N, 3, 2) are the
        texture coordinates of the faces' corners."""
        if filter == "nearest":
            return nearest(texture, self.floor(in_texels(texture, uv)), wraps)
        if filter == "linear":
            return bilinear(texture, uv, wraps)
        assert corners is not None
        return pyramid_of(self._surfaces, texture).look_up(level(texture, corners, self._spread), uv, wraps)

    @cached_property
    def _spread(self) -> Tensor:
        """Return Footprints.spread() (N, 2, 2) float64."""
        if self._rays_at is None or self._pixel is None or isinstance(self._view, Rays):
            raise ValueError("mipmap: expected hits of a camera, for rays of trace() have no neighbours; leave it out")
        return Footprints(self._surfaces, self._view, self._face, self._pixel, self._rays_at).spread()

    # -- discontinuities -----------------------------------------------------------------------------------------------

    def where(self, s: Tensor, a: Tensor | float, b: Tensor | float) -> Tensor:
        """Return `a` where s > 0 and `b` elsewhere (N, C). The discontinuity is declared: where it lies has a gradient.

        s      (N,) or (N, 1), any differentiable function of the point: s = 0 is the border
        a, b   rows (N, C), a colour (C,), or a number

        torch.where() gives the same image, but no gradient for the border. Borders are found along lines through the image,
        a pixel apart by default (Sampling.discontinuity_spacing); two that lie closer may be missed. A shader must call where(),
        floor() and nearest lookups equally often, in the same order, whatever its points. For hits that are not of render()'s
        shader, where() is torch.where(). Raises TypeError or ValueError that names the argument.
        """
        s = _function("s", s)
        check_shape("s", s, (len(self),), (len(self), 1))
        up = self._discontinuities.above_zero(s.reshape(-1))[:, None]
        sides = []
        for name, side in (("a", a), ("b", b)):
            value = as_tensor(name, side, like=s, floating=True)
            if value.dim() > 2 or (value.dim() == 2 and value.shape[0] not in (1, len(self))):
                raise ValueError(f"{name}: expected rows (N, C), a colour (C,) or a number, got {tuple(value.shape)}")
            if value.dim() == 1 and (value.shape[0] > 1024 or 64 < value.shape[0] == len(self)):
                raise ValueError(
                    f"{name}: expected rows (N, C), a colour (C,) or a number, got shape {tuple(value.shape)}; a number a point "
                    "is value[:, None]"
                )
            sides.append(value)
        channels = [value.shape[-1] if value.dim() else 1 for value in sides]
        if channels[0] != channels[1] and 1 not in channels:
            raise ValueError(f"b: expected as many channels as a has, {channels[0]}, got {channels[1]}")
        return torch.where(up, *sides)

    def floor(self, t: Tensor) -> Tensor:
        """Return the largest integers not above t (N,) or (N, K), whose jumps are declared discontinuities: see where(). For
        checkerboards, stripes, tables. Raises TypeError or ValueError that names the argument."""
        t = _function("t", t)
        check_shape("t", t, (len(self),), (len(self), "K"))
        if t.dim() == 1:
            return self._discontinuities.floor(t)
        return torch.stack([self._discontinuities.floor(column) for column in t.unbind(1)], 1)

    # -- shadows -------------------------------------------------------------------------------------------------------

    def visible(self, points: Tensor) -> Tensor:
        """Return (N,) bool, whether nothing lies between each point and another, `points` (N, 3) or (3,) in world coordinates.

        A shadow ray ignores the face of its point, and what touches either end up to the rounding of the coordinates. There is
        no derivative, and what moves the border of such a shadow has no gradient: see visible_from(). Raises TypeError or
        ValueError that names the argument.
        """
        s = self._surfaces
        points = as_tensor("points", points, like=s.verts, floating=True)
        check_float("points", points)
        check_shape("points", points, (3,), (len(self), 3))
        check_finite("points", points)
        points = points.detach().expand(len(self), 3)
        size = torch.maximum(points.abs().amax(1), self.position.detach().abs().amax(1)).double()
        spacing = max(torch.finfo(t.dtype).eps for t in (points, s.verts))
        return visible(s.casters, self._face, self._exact[:, 1:], points.double(), 16 * spacing * size)

    # -- lights --------------------------------------------------------------------------------------------------------

    @property
    def lights(self) -> tuple[Light, ...]:
        """The scene's lights that cast shadows: those of scene.lights, then the meshes that emit."""
        return self._surfaces.scene.casting

    def random(self, n: int, stream: int = 0, part: int = 0, parts: int = 1) -> Tensor:
        """Return random numbers (N, n) float64, uniform in [0, 1), without derivatives. All points of one sample, such as both
        sides of an edge, get the same numbers. Those of successive points, and of the `parts` of one point, fill the unit cube
        evenly (a Kronecker sequence with the powers of the generalised golden ratio of three dimensions). Each `stream` gives
        other numbers."""
        n, parts = check_int("n", n, 0, 1 << 16), check_int("parts", parts, 1, 1 << 31)
        part = check_int("part", part, 0, parts - 1)
        return uniform(self._seed * parts + part, n, check_int("stream", stream, 0, 1 << 31))

    def light_points(
        self, light: Light, sample: int = 0, samples: int = 1, by: LightSampler | None = None
    ) -> LightPoints:
        """Return a point of a light of `lights` for each of the N points. With several `samples` of a light, `sample` is the
        number of this one. light.place() and light.arriving() take the result.

        by   None: drawn in proportion to what the light emits. eg.lights.points_by_material: as render() draws them, by what the
             material of the point's mesh makes of them where nothing lies between; on glossy ones the density is then that of
             the choice among some candidates, infinite where none gives anything. For hits of trace() it is as None

        A mean of any function of the point over the density is right with either, but points_by_material draws nothing of what
        the material scatters not at all. There are no derivatives by where points are drawn. Raises TypeError or ValueError.
        """
        index = self._index(light)
        if by is not None and not callable(by):
            raise TypeError(f"by: expected a function such as eg.lights.points_by_material, or None, got {by!r}")
        samples = check_positive_int("samples", samples)
        sample = check_int("sample", sample, 0, samples - 1)
        if by is not None:
            if (by, index, samples) not in self._drawn:
                drawn = by(self, light, samples)
                if not (isinstance(drawn, list) and len(drawn) == samples and isinstance(drawn[0], LightPoints)):
                    raise TypeError(
                        f"by: expected a function that returns a list of {samples} LightPoints, got {drawn!r}"
                    )
                self._drawn[by, index, samples] = drawn
            return self._drawn[by, index, samples][sample]
        points = light.draw(sobol(self._seed, key_of(index, 0), sample, samples))
        forced = self._forced
        return points if forced is None or forced.light != index else forced.among(points)

    def visible_from(self, light: Light, points: LightPoints) -> Tensor:
        """Return 1 (N,) where nothing lies between the points and those of a light, else 0: see visible(). It has no
        derivative, but the renderer samples the borders of the light's shadow, so what moves them has a gradient."""
        index, s, forced = self._index(light), self._surfaces, self._forced
        s.shadowing.add(index)
        if forced is not None and forced.light == index and values_visible(forced.some) and bool(forced.some.all()):
            return forced.lit.to(self.position.dtype)
        place, near = seen_from(light, points, s, self.position.detach().double())
        lit = visible(s.casters, self._face, self._exact[:, 1:], place, near)
        self._note_visibility(index, lit)
        lit = lit.to(self.position.dtype)
        if forced is None or forced.light != index:
            return lit
        return torch.where(forced.some, forced.lit.to(lit), lit)

    def _note_visibility(self, light: int, lit: Tensor) -> None:
        """Keeps (N,) 1 seen, 0 hidden, −1 not asked, with the hits that these are a subset of."""
        if not values_visible(lit):
            return
        lit = lit.to(torch.int8)
        if self._all is None:
            self._lit[light] = lit
            return
        every, rows = self._all
        known = every._lit.setdefault(light, lit.new_full((len(every),), -1))
        known.index_copy_(0, rows, lit)

    @property
    def _only_light(self) -> bool:
        """Return whether only the radiance that one light adds is wanted."""
        return self._forced is not None and self._forced.only

    def _knows_light(self, light: Light) -> bool:
        """Return whether the points of this light are given, for these hits lie on the boundary of its shadow."""
        return self._forced is not None and self._forced.light == self._index(light)

    def _index(self, light: Light) -> int:
        for i, known in enumerate(self.lights):
            if known is light:
                return i
        raise ValueError(f"light: expected one of hits.lights, got {light!r}; lights are told apart by what they are")


def _function(name: str, value: Tensor) -> Tensor:
    """Return the function of a discontinuity, finite, and not in the half precision that autocast gives. Raises TypeError or
    ValueError."""
    value = as_tensor(name, value, floating=True)
    if value.dtype in (torch.float16, torch.bfloat16):
        value = value.float()
    check_float(name, value)
    if values_visible(value) and not bool(torch.isfinite(value.detach()).all()):
        raise ValueError(
            f"{name}: expected finite numbers, got {value.detach()[~torch.isfinite(value.detach())][0].item()}"
        )
    return value
