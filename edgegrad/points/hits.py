"""Hits: the points of surfaces that a shader written in PyTorch is given, and what it may ask of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..check import as_tensor, check_finite, check_float, check_int, check_positive_int, check_shape, values_visible
from ..scene.lights import Light, LightPoints
from ..scene.rows import interpolated, rows_of
from ..scene.textures import bilinear, in_texels, nearest
from .discontinuities import Discontinuities, DiscontinuitiesOfSubset
from .footprints import Footprints, level, pyramid_of
from .hit_arguments import as_attribute, as_function, as_rows, as_sides, as_texture
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

    Examples
    --------
    >>> import edgegrad as eg
    >>> def two_halves(hits):
    ...     return hits.where(hits.position[:, 0], hits.normal.abs(), 0.2)
    >>> camera = eg.Camera.look_at((0, 0, 4), (0, 0, 0), size=(8, 8))
    >>> eg.render(eg.shapes.box(), camera, shader=two_halves).shape
    torch.Size([8, 8, 3])
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
        """Return some of the points, or all in another order.

        Discontinuities that where() and floor() declare of them are those of the whole.

        Parameters
        ----------
        index : (M,) int, each once, or a mask (N,); others raise TypeError or ValueError
        """
        count = len(self)
        index = as_rows(index, count, self._face.device)
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
        """Return the places in the image (N, 2) in pixels: x right, y down."""
        if self._pixel is None:
            raise ValueError("hits.pixel: expected hits of a camera, these are of rays; see hits.ray")
        return self._pixel.to(self._surfaces.verts.dtype)

    @property
    def ray(self) -> Tensor:
        """Return the rows (N,) int64 of the rays, for hits that trace() found."""
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
        """Return the faces (N,) int64, as the scene counts them, mesh after mesh."""
        self._note_faces()
        return self._face

    @property
    def mesh(self) -> Tensor:
        """Return the meshes (N,) int64 of the scene."""
        s = self._surfaces
        self._note_jump("mesh", lambda: s.mesh_of_face[:, None, None].expand(-1, 3, 1))
        return s.mesh_of_face[self._face]

    @property
    def barycentrics(self) -> Tensor:
        """Return the weights (N, 3) of the corners of the face."""
        self._note_faces()
        return self._barycentrics

    @cached_property
    def position(self) -> Tensor:
        """Return the positions (N, 3) in world coordinates."""
        s = self._surfaces
        return interpolated(self._barycentrics, s.corners(self._face))

    @cached_property
    def depth(self) -> Tensor:
        """Return the depth (N,) along the camera's axis, world units; of trace(), along the ray, in lengths of its direction."""
        return self._view.depth(self.position).to(self.position.dtype)

    @cached_property
    def normal(self) -> Tensor:
        """Return the unit normals (N, 3) of the faces, on the side from which their vertices run counter-clockwise."""
        s = self._surfaces
        every = torch.arange(len(s.faces), device=s.verts.device)
        self._note_jump("normal", lambda: s.face_normals(every)[:, None].expand(-1, 3, -1))
        return s.face_normals(self._face)

    @cached_property
    def shading_normal(self) -> Tensor:
        """Return unit normals (N, 3) interpolated between the vertices': means of the faces' normals, weighted by area."""
        s = self._surfaces
        self._note_jump("shading_normal", lambda: s.vertex_normals[s.faces])
        normals = rows_of(s.vertex_normals, rows_of(s.faces, self._face))
        return normalize(interpolated(self._barycentrics, normals), dim=-1)

    @cached_property
    def uv(self) -> Tensor:
        """Return the texture coordinates (N, 2), v running up."""
        s = self._surfaces
        self._note_jump("uv", lambda: s.corner_uvs)
        return interpolated(self._barycentrics, rows_of(s.corner_uvs, self._face))

    @cached_property
    def view(self) -> Tensor:
        """Return unit directions (N, 3) to the eye, or back along the ray."""
        return self._view.to_viewer(self.position).to(self.position.dtype)

    def interpolate(self, attribute: Tensor, per: str | None = None) -> Tensor:
        """Return an attribute of the scene at the points, (N, K).

        Parameters
        ----------
        attribute : (V, K), (F, K) or (F, 3, K) float
            Of vertices, faces or corners of faces. Others raise TypeError or ValueError.
        per : "vertex", "face" or "corner"
            Where the shape does not say.
        """
        s = self._surfaces
        attribute, per = as_attribute(attribute, per, len(s.verts), len(s.faces))

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
        """Return the values (N, K) of a texture at the points. Raises TypeError or ValueError that names the argument.

        Parameters
        ----------
        texture : (h, w, K) float
            Row 0 on top.
        uv : (N, 2) float, default those of the surface
            Texture coordinates, v running up.
        wrap : "repeat", "clamp" or "mirror", or two of these, for u and for v
            Continuation beyond the border.
        mipmap : bool, default False
            True: texels are averaged over squares of 2, 4, 8 … so that neighbouring pixels are about a texel apart, linear
            between two such levels (Williams 1983). Only for hits of a camera.
        filter : "linear" or "nearest", default "linear"
            "linear" between the centres of texels; "nearest", the texel itself, whose edges are discontinuities: see where().
        """
        texture, wraps = as_texture(texture, wrap, filter, mipmap)
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

        torch.where() gives the same image, but no gradient for the border. Borders are found along lines through the image, a
        pixel apart by default (Sampling.discontinuity_spacing); two that lie closer may be missed. A shader must call where(),
        floor() and nearest lookups equally often, in the same order, whatever its points. For hits that are not of render()'s
        shader, where() is torch.where().

        Parameters
        ----------
        s : (N,) or (N, 1)
            Any differentiable function of the point: s = 0 is the border.
        a, b : rows (N, C), a colour (C,), or a number
            Others raise TypeError or ValueError that names the argument.
        """
        s = as_function("s", s)
        check_shape("s", s, (len(self),), (len(self), 1))
        up = self._discontinuities.above_zero(s.reshape(-1))[:, None]
        return torch.where(up, *as_sides(a, b, s))

    def floor(self, t: Tensor) -> Tensor:
        """Return the largest integers not above t, whose jumps are declared discontinuities: for checkerboards and stripes.

        Parameters
        ----------
        t : (N,) or (N, K)
            See where(). Others raise TypeError or ValueError that names the argument.
        """
        t = as_function("t", t)
        check_shape("t", t, (len(self),), (len(self), "K"))
        if t.dim() == 1:
            return self._discontinuities.floor(t)
        return torch.stack([self._discontinuities.floor(column) for column in t.unbind(1)], 1)

    # -- shadows -------------------------------------------------------------------------------------------------------

    def visible(self, points: Tensor) -> Tensor:
        """Return (N,) bool, whether nothing lies between each point and another.

        A shadow ray ignores the face of its point, and what touches either end up to the rounding of the coordinates. There is
        no derivative, and what moves the border of such a shadow has no gradient: see visible_from().

        Parameters
        ----------
        points : (N, 3) or (3,)
            World coordinates. Others raise TypeError or ValueError that names the argument.
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
        """Return the scene's lights that cast shadows: those of scene.lights, then the meshes that emit."""
        return self._surfaces.scene.casting

    def random(self, n: int, stream: int = 0, part: int = 0, parts: int = 1) -> Tensor:
        """Return random numbers (N, n) float64, uniform in [0, 1), without derivatives.

        All points of one sample, such as both sides of an edge, get the same numbers. Those of successive points, and of the
        parts of one point, fill the unit cube evenly: a Kronecker sequence with powers of the generalised golden ratio of
        three dimensions.

        Parameters
        ----------
        n, stream : int, int, default 0
            Numbers a point, and a stream of which each gives other numbers.
        part, parts : int, default 0 of 1
            Which of the parts of each point it is. Others raise TypeError or ValueError.
        """
        n, parts = check_int("n", n, 0, 1 << 16), check_int("parts", parts, 1, 1 << 31)
        part = check_int("part", part, 0, parts - 1)
        return uniform(self._seed * parts + part, n, check_int("stream", stream, 0, 1 << 31))

    def light_points(
        self, light: Light, sample: int = 0, samples: int = 1, by: LightSampler | None = None
    ) -> LightPoints:
        """Return a point of a light for each of the N points, which light.place() and light.arriving() take.

        A mean of any function of the point over the density is right with either sampler, but points_by_material draws nothing
        of what the material scatters not at all. There are no derivatives by where points are drawn. Raises TypeError or
        ValueError that names the argument.

        Parameters
        ----------
        light : Light
            One of `lights`.
        sample, samples : int, default 0 of 1
            The number of this one among several samples of a light.
        by : eg.lights.points_by_material, default None
            None draws in proportion to what the light emits. points_by_material draws as render() does, by what the material
            of the point's mesh makes of it where nothing lies between; on glossy ones the density is then that of the choice
            among some candidates, infinite where none gives anything. For hits of trace() it is as None.
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
        """Return 1 (N,) where nothing lies between the points and those of a light by light_points(), else 0; see visible().

        It has no derivative, but the renderer samples the borders of the light's shadow, so what moves them has a gradient.
        """
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
