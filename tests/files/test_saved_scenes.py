"""save_scene() writes what load_scene(lit=True) and load_cameras() read as the same numbers and pictures; the rest is
named."""

import json
import math
import warnings

import pytest
import torch
from boxes import APPEARANCES, FACES, OWN, VERTS, box, color, data, schema
from scenes import cube, icosphere

import edgegrad as eg
from edgegrad.files.formats import gltf

random = torch.Generator().manual_seed(1)
POINT = eg.lights.PointLight((2.0, 3.0, 4.0), 20.0, torch.tensor([1.0, 0.5, 0.25]))
SPOT = eg.lights.SpotLight((0.5, 4.0, 1.0), (0.1, -2.0, -0.3), 30.0, None, 0.2, 0.7)
SUN = eg.lights.DirectionalLight((-3.0, -2.0, -4.0), 1.5, torch.tensor([2.0, 1.0, 0.5]))  # a colour beyond 1
CAMERA = eg.Camera.look_at((3, 2, 4), (0, 0, 0), size=(40, 56))


def ball(shift=(0.0, 1.5, 0.0), **look):
    mesh = icosphere(1)
    return eg.Mesh(0.6 * mesh.verts.float() + torch.tensor(shift), mesh.faces, **look)


def ground(**look):
    corners = torch.tensor([[-4.0, -1.2, 4.0], [4.0, -1.2, 4.0], [4.0, -1.2, -4.0], [-4.0, -1.2, -4.0]])
    return eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), **look)


EMITTING = eg.Material(base_color=0.0, emission=torch.tensor([9.0, 5.0, 2.0]))
WOOD = eg.Material(eg.Texture(color(), filter="mipmap"), roughness=eg.Texture(data(1, least=60)), metallic=0.2)
SCENES = {
    "plain": eg.Scene([eg.Mesh(VERTS, FACES)]),
    "plain colours": eg.Scene([box(**APPEARANCES["colours"]), ball(face_colors=torch.rand(80, 3, generator=random))]),
    "plain textures": eg.Scene([box(texture=color(), wrap="clamp"), ball()]),
    "lights on a ball": eg.Scene([ball(material=eg.Material(0.8)), ground(material=eg.Material())], lights=[POINT, SPOT, SUN]),
    "a shared material": eg.Scene(
        [box(WOOD), box(WOOD).transformed(t=(2.0, 0.0, -1.0)), ground(material=eg.Material(0.5, 0.0, 0.3))], lights=[SUN]
    ),
    "a shared texture": eg.Scene(
        [box(WOOD), box(WOOD.replace(metallic=0.8, two_sided=False)).transformed(t=(2.0, 0.0, -1.0))], lights=[POINT, SUN]
    ),
    "lit and unlit": eg.Scene(
        [box(texture=color()), ball(material=eg.Material(0.5), colors=torch.rand(42, 3, generator=random)), ground()],
        lights=[POINT],
    ),
    "a light": eg.Scene(
        [ground(material=eg.Material(0.7))],
        lights=[eg.shapes.rectangle((0.0, 3.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 0.5), material=EMITTING)],
    ),
    "normals and alpha-tested faces": eg.Scene(
        [
            box(eg.Material(0.6, 0.3, 0.5, normal_map=eg.Texture(data(least=128), **OWN)),
                normals=eg.Mesh(VERTS, FACES).vertex_normals()),
            box(eg.Material(eg.Texture(color())), alpha=data(1)[..., 0]).transformed(t=(0.0, 0.0, -3.0)),
            box(eg.Material(0.3, alpha_mode="BLEND"), alpha=torch.full((1, 1), 0.4)).transformed(t=(1.0, 0.5, 2.0), scale=0.3),
        ],
        lights=[SUN],
    ),
}  # fmt: skip


def saved(path, scene, cameras=None):
    """Save a scene, and return what is read, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.save_scene(path, scene, cameras)
        return eg.load_scene(path, lit=True)


def seen(scene):
    return eg.render(scene, CAMERA, spp=8, seed=1, sampling=eg.Sampling(lights=4))


@pytest.mark.parametrize("kind", ["glb", "gltf"])
@pytest.mark.parametrize("name", SCENES)
def test_scenes_come_back(name, kind, tmp_path):
    scene = SCENES[name]
    found = saved(tmp_path / f"a.{kind}", scene)
    assert len(found.meshes) == len(scene.meshes) and len(found.lights) == len(scene.lights)
    assert [m.material is None for m in found.meshes] == [m.material is None for m in scene.meshes]
    for mesh, given in zip(found.meshes, scene.meshes, strict=True):
        torch.testing.assert_close(mesh.verts[mesh.faces], given.verts[given.faces].float())
    torch.testing.assert_close(seen(found), seen(scene), rtol=1e-4, atol=1e-5)
    assert float(seen(scene).std()) > 0.02  # the pictures show


def test_lights_are_the_same(tmp_path):
    found = saved(tmp_path / "a.glb", eg.Scene([ball(material=eg.Material())], lights=[POINT, SPOT, SUN]))
    for light, given in zip(found.lights, (POINT, SPOT, SUN), strict=True):
        assert type(light) is type(given)
        for name in ("position", "inner_angle", "outer_angle"):
            if hasattr(given, name):
                torch.testing.assert_close(*(torch.as_tensor(getattr(x, name)).double() for x in (light, given)))
        if hasattr(given, "direction"):
            a, b = light.direction.double(), given.direction.double()
            torch.testing.assert_close(a / a.norm(), b / b.norm())
        one = torch.ones(3, dtype=torch.float64) if given.color is None else given.color.double()
        torch.testing.assert_close(float(light.intensity) * light.color.double(), float(given.intensity) * one)


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.0, 0.0, 5.0), (0.0, -1e-30, 0.0), (1e20, -2e20, 0.5e20)])
def test_suns_from_any_direction(direction, tmp_path):
    given = torch.tensor(direction, dtype=torch.float64)
    (sun,) = saved(tmp_path / "a.glb", eg.Scene([ball()], lights=[eg.lights.DirectionalLight(given)])).lights
    unit = given / given.abs().max()
    torch.testing.assert_close(sun.direction.double(), unit / unit.norm(), rtol=0, atol=1e-7)


CAMERAS = {
    "front": CAMERA,
    "up": eg.Camera.look_at((0.0, 5.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), fov_y=70.0, size=(40, 56)),
    "flat": eg.Camera.orthographic((0.0, 1.0, 5.0), (0.0, 0.0, 0.0), height=4.0, size=(40, 56)),
}


def test_cameras_come_back(tmp_path):
    saved(tmp_path / "a.glb", SCENES["plain colours"], CAMERAS)
    found = eg.load_cameras(tmp_path / "a.glb", (40, 56))
    assert list(found) == list(CAMERAS)
    for name, given in CAMERAS.items():
        camera = found[name].camera
        assert camera.projection == given.projection
        for field in ("world_to_camera", "K"):
            torch.testing.assert_close(getattr(camera, field), getattr(given, field).float(), rtol=1e-5, atol=1e-5)
    for several, names in (
        (CAMERA, ["camera"]),
        ([CAMERA, CAMERAS["up"]], ["camera 0", "camera 1"]),
        (eg.Camera.stack([CAMERA, CAMERAS["up"]]), ["camera 0", "camera 1"]),
    ):
        saved(tmp_path / "a.gltf", SCENES["plain"], several)
        assert list(eg.load_cameras(tmp_path / "a.gltf", (40, 56))) == names


def test_what_is_shared_stands_there_once(tmp_path):
    for name, materials, images in (("a shared material", 2, 2), ("a shared texture", 2, 2)):
        eg.save_scene(tmp_path / "a.glb", SCENES[name])
        tree = gltf.read((tmp_path / "a.glb").read_bytes(), "glb").tree
        assert (len(tree["materials"]), len(tree["images"])) == (materials, images)
    first, second, _ = eg.load_scene(saved_path(tmp_path, "a shared material"), lit=True).meshes
    assert first.material is second.material


def saved_path(folder, name):
    eg.save_scene(folder / "b.glb", SCENES[name])
    return folder / "b.glb"


def test_names(tmp_path):
    named = [box(name="crate"), box(name="crate").transformed(t=(3.0, 0.0, 0.0)), ball(name="ball"), ground()]
    found = saved(tmp_path / "a.glb", eg.Scene(named))
    assert [mesh.name for mesh in found.meshes] == ["crate", "crate", "ball", "geometry_3"]


def test_the_file_is_a_gltf(tmp_path):
    for name, scene in SCENES.items():
        eg.save_scene(tmp_path / "a.gltf", scene, CAMERAS)
        tree = json.loads((tmp_path / "a.gltf").read_text())
        schema().validate(tree)
        used = {e for m in tree.get("materials", []) for e in m.get("extensions", {})} | set(tree.get("extensions", {}))
        assert set(tree.get("extensionsUsed", [])) == used, name


K = CAMERA.K


@pytest.mark.parametrize(
    ("scene", "cameras", "message"),
    [
        (eg.Scene([ball()], lights=[SUN, eg.lights.Environment(torch.ones(3))]), None, r"no Environment \(lights\[1\]\)"),
        (
            eg.Scene([ball()], lights=[eg.lights.SphericalHarmonics(torch.ones(9, 3))]),
            None,
            r"no SphericalHarmonics \(lights\[0\]\)",
        ),
        (eg.Scene([ball()], torch.ones(3)), None, "no background"),
        (eg.Scene([ball()], lights=[SUN.replace(intensity=-1.0)]), None, r"no what takes light away of DirectionalLight"),
        (eg.Scene([ball(), ball(colors=torch.full((42, 3), 2.0))]), None, r"no colors beyond 0 … 1 of meshes\[1\]"),
        (eg.Scene([ball()]), {"a": CAMERA.crop(0, 0, 10, 10)}, r"no camera 'a' \(its principal point is off the middle\)"),
        (eg.Scene([ball()]), CAMERA.replace(K=K * torch.tensor([[2.0], [1.0], [1.0]])), r"no camera 'camera' \(its"),
        (eg.Scene([ball()]), [CAMERA.replace(distortion=torch.tensor([0.1, 0, 0, 0]))], r"no camera 'camera 0' \(its lens\)"),
        (eg.Scene([eg.Mesh(VERTS.double() + 1e7, FACES)]), None, "no positions beyond float32"),
    ],
)  # fmt: skip
def test_what_gltf_does_not_hold_is_named(scene, cameras, message, tmp_path):
    with pytest.warns(UserWarning, match=rf"save_scene: a\.glb holds {message}.*; torch\.save") as said:
        eg.save_scene(tmp_path / "a.glb", scene, cameras)
    assert len(said) == 1
    assert len(eg.load_scene(tmp_path / "a.glb", lit=True).meshes) == len(scene.meshes)  # the rest is there


def test_faults(tmp_path):
    scene = SCENES["plain"]
    for call, error, message in (
        (lambda: eg.save_scene(tmp_path / "a.obj", scene), ValueError, r"ends in \.glb, \.gltf, got '\.obj'"),
        (lambda: eg.save_scene(tmp_path / "a.glb", [scene]), TypeError, "scene: expected a Scene or a Mesh, got list"),
        (lambda: eg.save_scene(tmp_path / "a.glb", scene, "c"), TypeError, "cameras: expected a Camera, .* got str"),
        (lambda: eg.save_scene(tmp_path / "a.glb", scene, [3]), TypeError, r"cameras\['camera 0'\]: .* got int"),
        (lambda: eg.save_scene(tmp_path / "a.glb", eg.Mesh(VERTS, FACES, colors=torch.rand(8, 5))), ValueError,
         "scene: expected 1 or 3 channels, got 5"),
        (lambda: eg.save_mesh(tmp_path / "a.glb", scene), TypeError, "a Scene is for save_scene"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_angles_of_spots_up_to_a_right_one(tmp_path):
    spot = SPOT.replace(inner_angle=0.0, outer_angle=math.pi / 2)
    (found,) = saved(tmp_path / "a.glb", eg.Scene([cube_of()], lights=[spot])).lights
    assert float(found.outer_angle) == pytest.approx(math.pi / 2)


def cube_of():
    mesh = cube()
    return eg.Mesh(mesh.verts.float(), mesh.faces, material=eg.Material())
