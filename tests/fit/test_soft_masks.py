"""Fits under masks between 0 and 1, whatever a picture holds at the border of the object."""

import pytest
import torch
from brackets import START, bracket, camera, errors
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import fit_pose, fit_texture
from edgegrad.fit.views import over_black


def of_object(kind, image, alpha):
    """Return a picture that holds, at the object's border, its colour times alpha, its colour, or a mixture with the
    background."""
    if kind == "straight":
        return torch.where(alpha > 0.0, image / alpha.clamp(min=1e-6), 0.0)
    return image + (1.0 - alpha) * {"before black": 0.0, "photograph": 0.9}[kind]


@pytest.mark.parametrize(
    "kind", ["straight", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("before black", "photograph"))]
)
def test_what_a_picture_holds_at_a_soft_mask_does_not_matter(kind):
    view = camera(48)
    seen = eg.render_aovs(bracket(), view, ["image", "alpha"], spp=256, seed=1 << 40)
    image = of_object(kind, seen["image"], seen["alpha"])
    fit = fit_pose(bracket(), image, view, seen["alpha"], START, search=False, options=quiet(spp=128))
    degrees, percent = errors(fit)
    assert degrees < 0.08 and percent < 0.15, (degrees, percent)  # mostly 0.02 and 0.01; a hard mask: 0.7 and 0.8


def test_the_object_over_black():
    mask = torch.tensor([0.0, 0.0, 0.3, 0.6, 1.0, 1.0, 1.0, 0.5])[None, :, None]
    inside = torch.tensor([9.0, 9.0, 9.0, 9.0, 2.0, 3.0, 4.0, 9.0])[None, :, None]
    image, sure = over_black(inside, mask)
    torch.testing.assert_close(image.flatten(), torch.tensor([0.0, 0.0, 0.6, 1.2, 2.0, 3.0, 4.0, 2.0]))
    assert sure.flatten().tolist() == [1, 1, 0, 0, 1, 1, 1, 0]
    for same in (mask.round(), 0.5 * mask):  # nothing between, nothing full
        image, sure = over_black(inside, same)
        assert torch.equal(image, inside * same) and sure is None


@pytest.mark.parametrize("kind", ["before black", "straight", "photograph"])
def test_a_texture_under_a_soft_mask(kind):
    """A square has one colour, which the texture has at the border, too."""
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    square = eg.Mesh(torch.cat([2.0 * uvs - 1.0, torch.zeros(4, 1)], 1), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    square = square.replace(uvs=uvs, uv_faces=square.faces)
    view = eg.Camera.look_at((0.3, 0.2, 3.0), (0, 0, 0), size=(32, 32))
    colour = torch.tensor([0.8, 0.5, 0.2])
    seen = eg.render_aovs(square.replace(texture=colour.expand(8, 8, 3)), view, ["image", "alpha"], spp=256, seed=9)
    image = of_object(kind, seen["image"], seen["alpha"])
    options = {"steps": 80, "spp": 8, "progress": False}
    fit = fit_texture(square, image, view, 8, masks=seen["alpha"], **arranged(**options))
    torch.testing.assert_close(fit.mesh.texture, colour.expand(8, 8, 3), atol=0.03, rtol=0)
