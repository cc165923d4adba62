"""What the live view shows, by what its server holds; no browser is needed."""

import io

import numpy as np
import pytest
import torch
import trimesh
from brackets import START, before_sky, bracket, camera, picture
from live_fixtures import page
from quiet_fits import arranged
from small_scenes import QUIET, pictures, views

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb
from edgegrad.fit import Refinement, fit_camera, fit_pose, fit_rig, fit_shape, fit_texture
from edgegrad.fit.views import white_level
from edgegrad.live import snapshot, view

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]

viser = pytest.importorskip("viser", reason="the live view needs edgegrad[view]")
pytest_plugins = "live_fixtures"


def vertices(handle):
    """Return world positions of what the server shows."""
    if isinstance(handle, viser.MeshHandle):
        points = handle.vertices
    else:
        points = trimesh.load(io.BytesIO(handle.glb_data), file_type="glb", force="mesh").vertices
    scale = handle.scale
    return viser.transforms.SO3(handle.wxyz).as_matrix() @ (scale * np.asarray(points, float)).T + np.reshape(
        handle.position, (3, 1)
    )


def extent(points):
    return np.concatenate([points.min(1), points.max(1)])


def test_a_pose_moves_the_mesh_and_keeps_the_camera(viewer):
    at = camera(32)
    fit = fit_pose(before_sky(), picture(at), at, init=START, search=False, **arranged(callback=viewer, **QUIET))
    viewer.show(fit)
    moved = bracket().verts @ fit.matrix[:3, :3].T + fit.matrix[:3, 3]
    shown = vertices(page(viewer)._meshes[0].handle)
    np.testing.assert_allclose(extent(shown), extent(moved.T.numpy()), atol=1e-5)
    (_, frustum) = page(viewer)._frusta[0]
    np.testing.assert_allclose(frustum.position, at.eye, atol=1e-9)
    forward = viser.transforms.SO3(frustum.wxyz).as_matrix()[:, 2]
    np.testing.assert_allclose(forward, at.world_to_camera[2, :3], atol=1e-9)
    assert np.degrees(frustum.fov) == pytest.approx(float(at.fov_y)) and frustum.aspect == pytest.approx(1.0)
    assert frustum.image.shape == (32, 32, 3)
    target, _, apart = np.split(page(viewer).picture.image.astype(int), 3, axis=1)
    seen = picture(at) / white_level(picture(at).flatten(0, 1))  # in units of its white, as it is compared
    np.testing.assert_array_equal(target, (linear_to_srgb(seen.clamp(0, 1)) * 255).round().numpy())
    assert apart.mean() < 25  # four times the difference
    assert len(viewer._losses) == fit.steps - 1 and len(page(viewer).curve.data[0]) == fit.steps - 1
    assert page(viewer).status.content.startswith(f"step {fit.steps - 1}, loss ")


def test_a_camera_moves_before_a_scene_at_rest(viewer):
    at = camera(32)
    away = at.world_to_camera.clone()
    away[0, 3] += 0.1
    fit = fit_camera(
        before_sky(), picture(at), at.replace(world_to_camera=away), focal=False, search=False,
        **arranged(callback=viewer, **QUIET | {"spp": 32, "steps": 12}),
    )  # fmt: skip
    viewer.show(fit)
    np.testing.assert_allclose(
        extent(vertices(page(viewer)._meshes[0].handle)), extent(bracket().verts.T.numpy()), atol=1e-6
    )
    np.testing.assert_allclose(page(viewer)._frusta[0][1].position, fit.camera.eye, atol=1e-9)
    assert float((fit.camera.eye - at.eye).norm()) < 0.02  # of 0.1; over seeds up to 0.009


def test_the_skeleton_of_a_rig_is_drawn(viewer, monkeypatch):
    from arms import arm, shown
    from arms import views as around

    monkeypatch.setattr(view, "MIN_INTERVAL", 0.0)
    rig, cameras = arm(3), around(24, 2)
    masks = shown(rig.posed({"bone 1": [0.0, 0.0, 0.6]}), cameras)
    seen = []

    def look(progress):
        viewer(progress)
        seen.append(progress.bones)

    fit = fit_rig(rig, None, cameras, masks=masks, search=0, **arranged(steps=3, coarsest=24, callback=look, **QUIET))
    viewer.show(fit)
    assert len(seen) == fit.history[-1].step + 1 and seen[0].shape == (2, 2, 3) and not torch.equal(seen[0], seen[-1])
    joints = rig.shape({"rotations": fit.values["rotations"]}, translation=fit.values["translation"]).joints
    np.testing.assert_allclose(page(viewer)._bones.points, torch.stack([joints[:2], joints[1:]], 1), atol=1e-6)
    assert page(viewer)._meshes[0].handle.opacity < 1.0
    _, render, _ = snapshot.snapshot_from_fit(fit).panel(0)
    x, y = cameras[0].project(joints.mean(0, keepdim=True).float())[0].long().tolist()
    orange = (render == snapshot.as_bytes(torch.tensor(snapshot.BONE))).all(-1)
    assert orange[y - 2 : y + 3, x - 2 : x + 3].any() and not orange[:, 0].any()


def test_shapes_are_shown_as_they_move_also_after_remeshing(viewer, monkeypatch):
    cameras = views(2)
    masks = [
        eg.render_aovs(eg.Mesh(bracket().verts, bracket().faces), one, ["alpha"], spp=16, seed=0)["alpha"]
        for one in cameras
    ]
    ball = trimesh.creation.icosphere(2, 1.2)
    ball.vertices += [1.0, 0.75, 0.4]
    start = eg.Mesh(torch.tensor(ball.vertices).float(), torch.tensor(ball.faces))
    seen = []
    monkeypatch.setattr(view, "MIN_INTERVAL", 0.0)

    def look(progress):
        viewer(progress)
        seen.append((progress.step, len(progress.scene.meshes[0].faces), progress.views[0].camera.size))

    fit = fit_shape(
        start, None, cameras, masks=masks, refinement=Refinement(levels=2, faces=600),
        **arranged(steps=4, callback=look, **QUIET),
    )  # fmt: skip
    viewer.show(fit)
    handle = page(viewer)._meshes[0].handle
    np.testing.assert_allclose(handle.vertices, fit.mesh.verts, atol=1e-6)
    assert seen[0][1] == 320 != seen[-1][1] == len(fit.mesh.faces) == len(handle.faces)
    assert page(viewer).view.options == ("1", "2") and page(viewer).view.visible


def test_textures_and_colours_are_those_of_the_mesh(viewer, tmp_path):
    square = eg.Mesh(
        torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]]),
        texture=torch.full((4, 4, 3), 0.3), uvs=torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]]),
        uv_faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )  # fmt: skip
    at = eg.Camera.look_at((0.5, 0.5, 2.0), (0.5, 0.5, 0.0), size=(16, 16))
    fit = fit_texture(square, torch.full((16, 16, 3), 0.6), at, (4, 4), **arranged(steps=30, callback=viewer, **QUIET))
    viewer.show(fit)
    loaded = trimesh.load(io.BytesIO(page(viewer)._meshes[0].handle.glb_data), file_type="glb", force="mesh")
    texels = np.asarray(loaded.visual.material.baseColorTexture)[..., :3]
    want = (linear_to_srgb(fit.mesh.texture.clamp(0, 1)) * 255).round().numpy()
    np.testing.assert_array_equal(texels, want)
    red = eg.Mesh(square.verts, square.faces, colors=torch.tensor([[0.5, 0.0, 0.0]]).expand(4, 3))
    viewer._next = 0.0
    assert viewer.update(red)
    assert torch.equal(shown(viewer, tmp_path).colors, red.colors)  # linear, as in glTF
    faces = red.replace(face_colors=torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.25, 1.0]]))
    viewer._next = 0.0
    assert viewer.update(faces)
    found = shown(viewer, tmp_path)
    assert torch.equal(found.corner_colors, faces.face_colors[:, None].expand(-1, 3, -1))
    assert found.material.two_sided and float(found.material.base_color.mean()) == 1.0 and found.normals is not None


def test_materials_are_those_of_the_mesh(viewer, tmp_path, monkeypatch):
    """A GLB holds all materials; a mesh of one matt colour is drawn as vertices that may move."""
    monkeypatch.setattr(view, "MIN_INTERVAL", 0.0)
    viewer._next = 0.0
    verts, faces = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    square = eg.Mesh(verts, faces, uvs=verts[:, :2], uv_faces=faces)
    base = torch.arange(12).reshape(2, 2, 3) / 12.0
    material = eg.Material(
        eg.Texture(base, factor=torch.tensor([1.0, 0.5, 0.25]), wrap="clamp", filter="nearest"), metallic=0.75, roughness=0.25,
        emission=torch.tensor([0.0, 2.0, 0.0]), two_sided=False,
    )  # fmt: skip

    def update(mesh):
        viewer._next = 0.0
        assert viewer.update(mesh)
        return page(viewer)._meshes[0].handle

    update(square.replace(material=material))
    found = shown(viewer, tmp_path).material
    torch.testing.assert_close(found.base_color.image, base, atol=4e-3, rtol=0)
    torch.testing.assert_close(found.base_color.factor, material.base_color.factor)
    assert (found.base_color.wraps, found.base_color.filter) == (("clamp", "clamp"), "nearest")
    assert (float(found.metallic), float(found.roughness), found.two_sided) == (0.75, 0.25, False)
    assert found.emission.tolist() == [0, 2, 0]
    colors = torch.rand(4, 3)
    update(square.replace(colors=colors, material=eg.Material(torch.tensor([0.2, 1.0, 0.2]))))
    torch.testing.assert_close(shown(viewer, tmp_path).colors, colors)
    torch.testing.assert_close(shown(viewer, tmp_path).material.base_color, torch.tensor([0.2, 1.0, 0.2]))
    # What is no tensor counts as well.
    cut = square.replace(alpha=torch.tensor([[0.0, 1.0]]))
    update(cut)
    update(cut.replace(alpha_cutoff=0.25))
    assert shown(viewer, tmp_path).alpha_cutoff == 0.25

    matt = square.replace(material=eg.Material(torch.tensor([1.0, 0.0, 0.2158605]), two_sided=False))
    handle = update(matt)
    assert isinstance(handle, viser.MeshHandle) and tuple(handle.color) == (255, 0, 128)
    assert (handle.side, handle.flat_shading) == ("front", True)
    assert update(matt.replace(verts=2 * verts)) is handle and handle.vertices.max() == 2.0
    assert update(matt.replace(material=eg.Material(0.5))) is not handle


def shown(viewer, folder):
    """Read the page's GLB by load_mesh."""
    (folder / "shown.glb").write_bytes(page(viewer)._meshes[0].handle.glb_data)
    return eg.load_mesh(folder / "shown.glb", lit=True)


def test_update_in_a_loop_of_ones_own(viewer, monkeypatch):
    monkeypatch.setattr(view, "MIN_INTERVAL", 0.0)
    at = eg.Camera.stack(views(2))
    mesh = bracket()
    images = torch.stack(pictures(mesh, list(at)))
    verts = mesh.verts.clone().requires_grad_()
    for k in range(3):
        assert viewer.update(mesh.replace(verts=verts), at, images, loss=torch.tensor(1.0 / (k + 1)))
    held = vertices(page(viewer)._meshes[0].handle)
    with torch.no_grad():
        verts += 1.0  # in place: what is shown stays as it was
    viewer._select_camera(1)
    np.testing.assert_allclose(vertices(page(viewer)._meshes[0].handle), held)
    target, render, _ = np.split(page(viewer).picture.image.astype(int), 3, axis=1)
    np.testing.assert_array_equal(target, (linear_to_srgb(images[1].clamp(0, 1)) * 255).round().numpy())
    assert abs(target - render).mean() < 6
    np.testing.assert_allclose(page(viewer).curve.data, [[1, 2, 3], np.log10([1.0, 1 / 2, 1 / 3])])
    viewer.update(mesh)  # fewer cameras, no pictures
    assert not page(viewer)._frusta


@pytest.mark.parametrize("kind", ["orthographic", "fisheye", "panorama"])
def test_cameras_of_all_kinds_are_shown(viewer, kind):
    at = camera(16)
    K = at.K.clone() * torch.tensor([[0.4], [0.4], [1.0]])
    if kind == "panorama":
        K[:2, :2] = torch.eye(2) * 16 / 6.3
    assert viewer.update(bracket(), eg.Camera(at.world_to_camera, K, at.size, kind))
    assert 0.0 < page(viewer)._frusta[0][1].fov <= 2.0
    assert page(viewer).picture.image.shape == (16, 16, 3)  # the render alone
