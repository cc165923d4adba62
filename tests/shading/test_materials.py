"""Materials: the scattering functions against quadrature, parameters of every kind, normals, creases, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from finite_differences import Case, check, gradient
from lit_scenes import F64, ball, by_quadrature, directions, from_above, hits_of, plane, vector
from oracles.shading import radiance
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light.bsdf import Scattering, ggx, masking, terminator
from edgegrad.points.hits import Hits

UP = vector(0, 0, 1)


def scattering(base: float, metallic: float | None, roughness: float | None) -> Scattering:
    def one(value: float | None) -> Tensor | None:
        return None if value is None else vector(value)[None]

    return Scattering(vector(base)[None], one(metallic), one(roughness))


def viewer(angle: float) -> Tensor:
    return vector(math.sin(angle), 0, math.cos(angle))


def albedo(material: Scattering, angle: float, n: int = 600) -> float:
    """∫ f cos over the light's directions."""
    l, solid = directions(n)
    f = material.evaluate(viewer(angle).expand(len(l), 3), UP.expand(len(l), 3), l)
    return float((f[:, 0] * l[:, 2]).sum() * solid)


# -- the scattering functions ----------------------------------------------------------------------------------------------


def test_derivatives_of_scattering():
    g = torch.Generator().manual_seed(0)
    count = 5
    n = normalize(vector(0.1, -0.2, 1), dim=0).expand(count, 3).clone()
    v, l = (
        normalize(torch.rand((count, 3), generator=g, dtype=F64) + vector(-0.5, -0.5, 0.3), dim=1) for _ in range(2)
    )
    base = torch.rand((count, 3), generator=g, dtype=F64)
    metallic, roughness = (0.1 + 0.8 * torch.rand((count, 1), generator=g, dtype=F64) for _ in range(2))
    leaves = [x.requires_grad_() for x in (base, metallic, roughness, v, n, l)]

    def of(base: Tensor, metallic: Tensor, roughness: Tensor, *vectors: Tensor) -> Tensor:
        return Scattering(base, metallic, roughness).evaluate(*vectors)

    assert gradcheck(of, leaves)
    tilted = [normalize(UP + vector(0.3, 0, 0), dim=0), UP, normalize(vector(0.8, 0.1, 0.2), dim=0)]
    assert gradcheck(terminator, [x[None].clone().requires_grad_() for x in tilted])


@pytest.mark.parametrize("roughness", [0.4, 0.7, 1.0])
def test_microfacets_are_normalised(roughness: float):
    """Projected areas of the facets are that of the surface, and what a direction sees of them is what it sees of the surface
    (the weak white furnace; Heitz 2014, eqs. 15 and 85)."""
    a2 = torch.tensor([[roughness**4]], dtype=F64)
    h, solid = directions(600)
    D = ggx(UP.expand(len(h), 3), h, a2)[:, 0]
    assert math.isclose(float((D * h[:, 2]).sum() * solid), 1, rel_tol=0.005)
    v = viewer(1.2)
    # With Λ = 0 of the other direction, masking() is G1 / 4 (n·v) (n·l); n·l → ∞ stands for that.
    nv = v[2].reshape(1, 1)
    smith = 2 * nv / (nv + (a2 + (1 - a2) * nv**2).sqrt())
    visible = (h @ v).clamp(min=0)
    assert math.isclose(float((smith[0] * D * visible).sum() * solid), float(v[2]), rel_tol=0.005)
    both = masking(nv, nv, a2)
    tail = ((a2 + (1 - a2) * nv**2).sqrt() / nv - 1) / 2  # Λ
    torch.testing.assert_close(both, 1 / (1 + 2 * tail) / (4 * nv * nv))


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.3, 1.5])
def test_white_furnace(angle: float):
    """No more comes back than came. Of a white base under a dielectric layer glTF's formula itself returns more at grazing
    angles, for what the layer takes from the base goes by another half vector than what it reflects: 1.14 at 1.3 rad."""
    for roughness in (0.3, 0.6, 1.0):
        assert 0.3 < albedo(scattering(1.0, 1.0, roughness), angle, 300) <= 1.001
        assert 0.01 < albedo(scattering(0.0, 0.0, roughness), angle, 300) <= 1.001
    assert math.isclose(albedo(scattering(1.0, None, None), angle, 300), 1, rel_tol=1e-4)
    assert albedo(scattering(1.0, 1.0, 0.3), angle, 300) > 0.98 or angle > 1  # nearly a mirror


def test_a_white_dielectric_is_as_gltf_has_it():
    assert math.isclose(albedo(scattering(1.0, 0.0, 0.3), 1.3), 1.142, rel_tol=0.005)


def test_scattering_is_reciprocal():
    g = torch.Generator().manual_seed(3)
    a, b = (normalize(torch.rand((50, 3), generator=g, dtype=F64) + vector(-0.5, -0.5, 0), dim=1) for _ in range(2))
    material = scattering(0.7, 0.4, 0.3)
    torch.testing.assert_close(material.evaluate(a, UP.expand(50, 3), b), material.evaluate(b, UP.expand(50, 3), a))


@pytest.mark.parametrize("smoothness", [0.0, 1e-9, 1.0])
def test_extremes_are_finite(smoothness: float):
    material = scattering(1.0, 1.0, 1 - smoothness if smoothness else 0.0)
    v = torch.stack([UP, viewer(math.pi / 2 - 1e-9), viewer(1.0)]).float()
    l = v * torch.tensor([-1.0, -1, 1])
    material = Scattering(*(part.float() for part in material if part is not None))
    n = UP.float().expand(3, 3).clone().requires_grad_()
    f = material.evaluate(v, n, l)
    assert bool(torch.isfinite(f).all()) and bool(torch.isfinite(torch.autograd.grad(f.sum(), n)[0]).all())


# -- rendered --------------------------------------------------------------------------------------------------------------


def at_origin(material: eg.Material, lights: list[Any], count: int = 4096, angle: float = 0.0, **fields: Any) -> Tensor:
    """(C,) the mean radiance of the origin of a plane seen at an angle."""
    scene = eg.Scene([plane(material=material, **fields)], lights=lights)
    return radiance(hits_of(scene, count, view=viewer(angle))).mean(0)


def test_lambert_under_a_constant_environment():
    """Radiance base · E, for the irradiance is π E: also of a ball, whose points all see half of it."""
    base, E = vector(0.8, 0.5, 0.2), vector(1.0, 2.0, 3.0)
    torch.testing.assert_close(at_origin(eg.Material(base), [eg.lights.Environment(E)]), base * E, rtol=0.005, atol=0)
    scene = eg.Scene([ball(3, smooth=False, material=eg.Material(base))], lights=[eg.lights.Environment(E)])
    image = eg.render(scene, from_above(16, 1.2), sampling=eg.Sampling(lights=64), seed=0)
    torch.testing.assert_close(image.mean((0, 1)), base * E, rtol=0.005, atol=0)


@pytest.mark.parametrize(("metallic", "roughness", "angle"), [(1.0, 0.5, 0.3), (0.0, 0.4, 1.2), (0.5, 1.0, 0.8)])
def test_energy_of_glossy_surfaces(metallic: float, roughness: float, angle: float):
    found = at_origin(eg.Material(0.9, metallic, roughness), [eg.lights.Environment([1.0])], 1 << 13, angle)
    exact = albedo(scattering(0.9, metallic, roughness), angle)
    assert math.isclose(float(found[0]), exact, rel_tol=0.01)


def test_parameters_of_every_kind_agree():
    lights = [eg.lights.PointLight([0.5, 0.5, 1.0]), eg.lights.SphericalHarmonics(0.1 + torch.rand(9, 3, dtype=F64))]
    values = {
        "base_color": vector(0.8, 0.5, 0.2),
        "metallic": vector(0.3),
        "roughness": vector(0.4),
        "emission": vector(0.1, 0.2, 0.3),
    }
    constant = at_origin(eg.Material(**values), lights, 1)
    of_verts = {name: value.expand(4, -1) for name, value in values.items()}
    torch.testing.assert_close(at_origin(eg.Material(**of_verts), lights, 1), constant)
    for filter in ("linear", "nearest"):
        images = {
            name: eg.Texture(value.expand(3, 5, -1) / 2, factor=2.0, filter=filter) for name, value in values.items()
        }
        torch.testing.assert_close(at_origin(eg.Material(**images), lights, 1), constant)
    own = plane().uvs
    image = eg.Texture(values["base_color"].expand(2, 2, 3), own, plane().uv_faces, wrap="clamp")
    torch.testing.assert_close(at_origin(eg.Material(**{**values, "base_color": image}), lights, 1), constant)
    # Colours of the mesh times texture times factor.
    half = vector(0.5, 0.5, 0.5)
    image = eg.Texture(values["base_color"].expand(2, 2, 3), factor=[4.0, 4.0, 4.0])
    for fields in (
        {"colors": half.expand(4, 3) / 2}, {"face_colors": half.expand(2, 3) / 2}, {"texture": half.expand(2, 2, 3) / 2},
        {"corner_colors": half.expand(2, 3, 3) / 2},
    ):  # fmt: skip
        found = at_origin(eg.Material(**{**values, "base_color": image}), lights, 1, **fields)
        torch.testing.assert_close(found, constant)
    plain = at_origin(eg.Material(), [eg.lights.DirectionalLight([0.0, 0, -1], math.pi)], 1)
    torch.testing.assert_close(plain, vector(0.7, 0.7, 0.7))


def test_emission_alone_is_the_unlit_image():
    colors = torch.rand((4, 3), dtype=F64, generator=torch.Generator().manual_seed(4))
    unlit = plane(0.8, colors=colors)
    emitting = plane(0.8, material=eg.Material(0.0, emission=colors))
    images = [eg.render(eg.Scene([mesh]), from_above(), 64, seed=0) for mesh in (unlit, emitting)]
    torch.testing.assert_close(images[1].mean((0, 1)), images[0].mean((0, 1)), rtol=0.01, atol=0)
    torch.testing.assert_close(*images, rtol=0.1, atol=0.05)
    # Next to a mesh that is lit, one without a material keeps its colours.
    both = eg.Scene([unlit, ball(1, material=eg.Material()).transformed(t=vector(0, 0, -9))])
    torch.testing.assert_close(
        eg.render(both, from_above(), 64, seed=0)[4:12, 4:12], images[0][4:12, 4:12], rtol=0.1, atol=0.05
    )


def test_back_sides():
    lights = [eg.lights.DirectionalLight([0.0, 0, 1.0], math.pi)]
    for two_sided, seen in ((True, 0.5), (False, 0.0)):
        scene = eg.Scene([plane(material=eg.Material(0.5, emission=0.25, two_sided=two_sided))], lights=lights)
        below = radiance(hits_of(scene, 1, view=vector(0, 0, -1)))
        torch.testing.assert_close(below[0, 0], vector(seen + (0.25 if two_sided else 0.0)).sum())
        above = radiance(hits_of(scene, 1))
        torch.testing.assert_close(above[0, 0], vector(0.25).sum())  # the light is on the other side


# -- normals ---------------------------------------------------------------------------------------------------------------


def test_vertex_normals():
    mesh = ball(3)
    assert mesh.normals is not None
    assert float((mesh.normals * normalize(mesh.verts, dim=1)).sum(1).min()) > 0.999
    alone = eg.Mesh(torch.cat([mesh.verts, vector(9, 9, 9)[None]]), mesh.faces).vertex_normals()
    assert torch.equal(alone[-1], vector(0, 0, 0))
    few = ball(0, smooth=False)
    assert gradcheck(lambda verts: eg.Mesh(verts, few.faces).vertex_normals(), few.verts.clone().requires_grad_())


def test_normal_maps():
    tilted = normalize(vector(0.3, 0.2, 1), dim=0)
    image = ((tilted + 1) / 2).expand(2, 2, 3)
    light = [eg.lights.DirectionalLight([-0.2, -0.4, -1.0])]
    # The uvs of the plane run along x and y, so the tangent frame is the world's.
    mapped = at_origin(eg.Material(1.0, normal_map=eg.Texture(image)), light, 1)
    given = at_origin(eg.Material(1.0), light, 1, normals=tilted.expand(4, 3))
    torch.testing.assert_close(mapped, given)
    flat = at_origin(eg.Material(1.0, normal_map=eg.Texture(image), normal_scale=0.0), light, 1)
    torch.testing.assert_close(flat, at_origin(eg.Material(1.0), light, 1))
    # An image that is mirrored along u tilts normals the other way along x.
    mirror = plane().uvs
    assert mirror is not None
    mirror = mirror * vector(-1, 1)
    other = at_origin(eg.Material(1.0, normal_map=eg.Texture(image, mirror, plane().uv_faces)), light, 1)
    torch.testing.assert_close(
        other, at_origin(eg.Material(1.0), light, 1, normals=(tilted * vector(-1, 1, 1)).expand(4, 3))
    )
    # Normals that oppose the faces are turned.
    torch.testing.assert_close(at_origin(eg.Material(1.0), light, 1, normals=-tilted.expand(4, 3)), given)
    # Normals of another index.
    rows = torch.zeros(2, 3, dtype=torch.int64)
    torch.testing.assert_close(at_origin(eg.Material(1.0), light, 1, normals=tilted[None], normal_faces=rows), given)


def test_light_ends_where_the_face_turns_away():
    """It ends without a jump, with interpolated normals, too."""
    n = normalize(vector(1.0, 0, 1), dim=0)
    seen = []
    for sine in (-0.01, 0.001, 0.01, 0.1):
        l = vector(math.sqrt(1 - sine**2), 0, sine)
        seen.append(float(at_origin(eg.Material(1.0), [eg.lights.DirectionalLight(-l)], 1, normals=n.expand(4, 3))[0]))
    assert seen[0] == 0 and 0 < seen[1] < 0.002 < seen[2] < 0.02 < seen[3]


def test_edges_where_lit_surfaces_jump():
    """Flat faces at every edge; interpolated normals by what the light that sinks behind a face loses."""

    def creases(mesh: eg.Mesh, light: Any) -> Tensor:
        scene = eg.Scene([mesh, plane(material=eg.Material()).transformed(t=vector(0, 0, -9))], lights=[light])
        hits = hits_of(scene, 1)
        radiance(hits)
        return hits._surfaces.crease_attributes()[: len(mesh.faces)]

    def jumping(attributes: Tensor, mesh: eg.Mesh) -> Tensor:
        """(V,) by how much corners at a vertex differ."""
        index = mesh.faces.reshape(-1)
        spread = []
        for sign in (1, -1):
            start = torch.full((len(mesh.verts), attributes.shape[-1]), -1e9, dtype=F64)
            rows = (sign * attributes).reshape(len(index), -1)
            spread.append(start.index_reduce(0, index, rows, "amax"))
        return (spread[0] + spread[1]).amax(1)

    sun = eg.lights.DirectionalLight([0.0, 0, -1.0])
    flat, smooth = ball(3, smooth=False, material=eg.Material()), ball(3, material=eg.Material())
    assert float(jumping(creases(flat, sun), flat).min()) > 1e-3
    z = smooth.verts[:, 2]
    by_light = jumping(creases(smooth, sun), smooth)
    assert float(by_light[z.abs() > 0.8].max()) < 0.1 * float(by_light[z.abs() < 0.1].max())
    wide = jumping(creases(smooth, eg.lights.Environment([1.0])), smooth)
    assert float(wide.min()) > 1e-3


@pytest.mark.parametrize("specular", [False, True])
def test_edges_where_no_light_jumps(specular: bool):
    """Points of light: where what is noted at both ends of an edge is the same on its sides, so is the radiance, and dark sides
    have no creases."""
    material = eg.Material(roughness=0.5) if specular else eg.Material()
    ball_ = ball(3, smooth=False, material=material)
    lights = [
        eg.lights.DirectionalLight([1.0, 0.3, -0.2]),
        eg.lights.PointLight([0.0, 3, 1.5], 20.0),
        eg.lights.SpotLight([0.0, 0.5, -4.0], [0.0, 0, 1.0], 9.0, outer_angle=0.05),
    ]
    for emitters in (lights[:1], lights[1:]):
        hits = eg.points.primary_hits(eg.Scene([ball_], lights=emitters), from_above(), seed=0).hits
        radiance(hits)
        noted = hits._surfaces.crease_attributes().double()
        edges: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for face, corners in enumerate(ball_.faces.tolist()):
            for i in range(3):
                j = (i + 1) % 3
                a, b = (i, j) if corners[i] < corners[j] else (j, i)
                edges.setdefault((corners[a], corners[b]), []).append((face, a, b))
        sides = torch.tensor(list(edges.values()))  # (E, 2, 3)
        face, ends = sides[..., 0], sides[..., 1:]
        at_ends = noted[face[..., None], ends]  # (E, side, end, K)
        same = (at_ends[:, 0] == at_ends[:, 1]).flatten(1).all(1)
        found = []
        for t in (0.5, 0.9):
            b = torch.zeros(*face.shape, 3, dtype=F64)
            b.scatter_(2, ends, torch.tensor([1 - t, t], dtype=F64).expand(*ends.shape))
            points = Hits(hits._surfaces, hits._view, face.reshape(-1), b.reshape(-1, 3))
            found.append(radiance(points, shadows=False).reshape(*face.shape, -1))
        jump = torch.stack([(side[:, 0] - side[:, 1]).abs().amax(1) for side in found]).amax(0)
        assert int(same.sum()) > 0.2 * len(same) and float(jump[same].max()) < 1e-12
        assert int((jump > 1e-4).sum()) > 0.3 * len(jump)


# -- gradients inside faces, and of what moves ------------------------------------------------------------------------------


def by_material(name: str) -> Case:
    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        roughness = 0.5 + theta if name == "roughness" else 0.5
        mesh = ball(2, material=eg.Material(vector(0.5, 0.6, 0.7), 0.4, roughness, emission=0.2))
        assert mesh.normals is not None
        if name == "normals":
            mesh = mesh.replace(normals=mesh.normals + theta * vector(0.5, 0.3, 0))
        if name == "verts":
            wave = 1 + theta * (1 + mesh.verts[:, :1])
            mesh = mesh.replace(
                verts=mesh.verts * wave, normals=eg.Mesh(mesh.verts * wave, mesh.faces).vertex_normals()
            )
        if name == "flat":
            mesh = mesh.replace(verts=mesh.verts * (1 + theta * (1 + mesh.verts[:, :1])), normals=None)
        return eg.Scene([mesh], lights=[eg.lights.PointLight([1.5, 2.0, 3.0], 20.0)]), from_above(16, 2.4)

    return case


@pytest.mark.parametrize(
    "name",
    [
        "roughness",
        pytest.param("normals", marks=pytest.mark.slow),
        pytest.param("verts", marks=pytest.mark.slow),
        pytest.param("flat", marks=pytest.mark.slow),
    ],
)
def test_gradients_by_materials_are_finite_differences(name: str):
    moves, options = name in ("verts", "flat"), {"shadows": False}
    exact = by_quadrature(by_material(name), 0.02 if moves else 1e-3, 24 if moves else 8, **options)
    samples = {"sampling": eg.Sampling(surface=40_000 if moves else 30_000, edges=40_000 if moves else 1000)}
    check(name, exact, gradient(by_material(name), 12 if name == "verts" else 8, **samples, **options))


@pytest.mark.slow
@pytest.mark.parametrize("filter", ["linear", "nearest"])
def test_gradients_by_texture_coordinates(filter: str):
    """Borders of nearest texels are steps."""

    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        mesh, turn = plane(1.0), torch.tensor([[0.85, 0.27], [-0.27, 0.85]], dtype=F64)
        assert mesh.uvs is not None
        image = torch.rand((5, 5, 3), dtype=F64, generator=torch.Generator().manual_seed(1))
        uvs = mesh.uvs @ turn + theta * vector(0.05, 0.03)
        mesh = mesh.replace(uvs=uvs, material=eg.Material(eg.Texture(image, filter=filter)))
        return eg.Scene([mesh], lights=[eg.lights.PointLight([1.0, 1.0, 3.0], 50.0)]), from_above(16, 1.9)

    exact = by_quadrature(case, 0.1, 56)
    check(
        filter, exact, gradient(case, 20, sampling=eg.Sampling(surface=20_000, edges=500, discontinuity_spacing=0.125))
    )


# -- what is refused ---------------------------------------------------------------------------------------------------------

IMAGE = torch.ones(2, 2, 3)
REFUSED: list[tuple[Callable[[], Any], type[Exception], str]] = [
    (lambda: eg.Material(base_color=IMAGE), ValueError, r"base_color: expected a number, .* eg\.Texture"),
    (lambda: eg.Material(base_color="red"), TypeError, "base_color: expected"),
    (lambda: eg.Material(base_color=[float("inf"), 0, 0]), ValueError, "base_color: expected finite"),
    (lambda: eg.Material(metallic=[0.1, 0.2]), ValueError, "metallic: expected one channel, got 2"),
    (lambda: eg.Material(roughness=eg.Texture(IMAGE)), ValueError, "roughness: expected one channel, got 3"),
    (lambda: eg.Material(normal_map=IMAGE), TypeError, "normal_map: expected a Texture"),
    (lambda: eg.Material(normal_map=eg.Texture(IMAGE[..., :1])), ValueError, r"normal_map: expected shape \(h, w, 3\)"),
    (lambda: eg.Material(normal_scale=[1.0, 2.0]), ValueError, "normal_scale: expected shape"),
    (lambda: eg.Material(two_sided=1), TypeError, "two_sided: expected True or False"),
    (lambda: eg.Material(alpha_mode="mask"), ValueError, "alpha_mode: expected one of OPAQUE, MASK, BLEND"),
    (lambda: eg.Texture(IMAGE[0]), ValueError, r"image: expected shape \(h, w, K\)"),
    (lambda: eg.Texture(IMAGE, torch.ones(3, 2)), ValueError, "uv_faces: expected both"),
    (lambda: eg.Texture(IMAGE, wrap="around"), ValueError, "wrap: expected one of repeat"),
    (lambda: eg.Texture(IMAGE, filter="cubic"), ValueError, "filter: expected one of linear, nearest, mipmap"),
    (lambda: eg.Texture(IMAGE, factor=[1.0, 2.0]), ValueError, r"factor: expected shape \(\) or \(3,\)"),
    (lambda: plane(material=3), TypeError, "material: expected a Material"),
    (
        lambda: plane(material=eg.Material(torch.ones(5, 3))),
        ValueError,
        r"material.base_color: expected shape \(4, C\)",
    ),
    (
        lambda: plane(material=eg.Material([1.0, 2.0], emission=[1.0, 2, 3])),
        ValueError,
        "material.emission: expected 2 channels",
    ),
    (
        lambda: plane(material=eg.Material([1.0, 2.0]), colors=torch.ones(4, 3)),
        ValueError,
        "material: expected 3 channels",
    ),
    (
        lambda: plane(alpha=torch.ones(2, 2), material=eg.Material(alpha_mode="OPAQUE")),
        ValueError,
        "alpha: expected None",
    ),
    (lambda: plane(normals=torch.ones(3, 3)), ValueError, "normal_faces: expected with 3 normals of 4 vertices"),
    (lambda: plane(normal_faces=torch.zeros(2, 3).long()), ValueError, "normals: expected with normal_faces"),
    (
        lambda: plane(normals=torch.ones(1, 3), normal_faces=torch.ones(2, 3).long()),
        ValueError,
        "normal_faces: expected indices",
    ),
    (
        lambda: eg.Mesh(torch.ones(3, 3), torch.tensor([[0, 1, 3]])).vertex_normals(),
        ValueError,
        "faces: expected indices",
    ),
    (
        lambda: eg.Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]]), material=eg.Material(eg.Texture(IMAGE))),
        ValueError,
        "material.base_color: expected texture coordinates",
    ),
    (
        lambda: plane(material=eg.Material(eg.Texture(IMAGE, torch.ones(1, 2), torch.zeros(1, 3).long()))),
        ValueError,
        "material.base_color: expected uv_faces with a row for each of 2 faces, got 1",
    ),
]


@pytest.mark.parametrize(("make", "error", "text"), REFUSED)
def test_what_is_refused(make: Callable[[], Any], error: type[Exception], text: str):
    with pytest.raises(error, match=text):
        make()


def test_repr_is_one_line():
    texture = eg.Texture(torch.rand(4, 5, 3), filter="mipmap", factor=0.5)
    assert repr(eg.Material(roughness=0.5, base_color=texture, emission=torch.rand(8, 3))) == (
        "Material(base_color=Texture((4, 5, 3), mipmap, repeat repeat, factor 0.5), roughness=0.5, emission=tensor (8, 3), "
        "normal_scale=1.0, two_sided=True, alpha_mode='MASK')"
    )
