"""The small functions of the kernel, each against its definition: adjoints, filters, sample points, edges."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from scenes import cube, icosphere
from scipy.special import erf

from edgegrad.library import core

pieces = core.for_tests
Arrays = Sequence[np.ndarray]


# -- adjoints ---------------------------------------------------------------------------------------------------------

# Central differences in double with steps of ε^⅓ ≈ 6e-6 are wrong by about 1e-10 of the function: h² from the third
# derivative, ε / h from rounding. 1e-6 leaves room for functions whose third derivative is large.
STEP, TOLERANCE = 6e-6, 1e-6
ROUNDING = 1e-9  # ε / h = 4e-11, and some: what the difference of equal functions of size 1 may be


def check_vjp(forward: Callable[..., np.ndarray], vjp: Callable[..., Arrays], inputs: Arrays, seed: int = 0) -> None:
    """Fails unless vjp(*inputs, bar) are the derivatives of bar · forward(*inputs), for a random cotangent bar."""
    inputs = [np.asarray(x, float) for x in inputs]
    bar = np.random.default_rng(seed).normal(size=np.shape(forward(*inputs)))
    found = vjp(*inputs, bar)
    assert len(found) == len(inputs)
    for which, (x, gradient) in enumerate(zip(inputs, found, strict=True)):
        expected = np.empty(x.shape)
        for index in np.ndindex(x.shape):
            step = np.zeros(x.shape)
            step[index] = STEP * max(1.0, abs(x[index]))
            above, below = ([*inputs[:which], x + s * step, *inputs[which + 1 :]] for s in (1, -1))
            expected[index] = np.sum(bar * (forward(*above) - forward(*below))) / (2 * step[index])
        atol = TOLERANCE * np.abs(expected).max() + ROUNDING
        np.testing.assert_allclose(np.asarray(gradient), expected, rtol=0, atol=atol, err_msg=f"input {which}")


def random(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


# Upper rows of K, with skew and with an entry where K usually has a zero: every one of the six has a derivative.
K6 = np.array([80.0, 7.0, 33.0, -3.0, 90.0, 25.0])
perspective = pytest.mark.parametrize("perspective", [True, False], ids=["perspective", "orthographic"])


def kernel_camera(
    k: np.ndarray, perspective: bool, lens: str = "pinhole", distortion: np.ndarray | None = None
) -> core.Camera:
    K = np.concatenate([k.reshape(2, 3), [[0.0, 0.0, 1.0]]])
    return core.Camera(np.eye(4), K, np.zeros(8) if distortion is None else distortion, perspective, lens, 64, 48)


# By lens: whether it is a perspective view, and coefficients of which each has a derivative.
LENSES = {
    "perspective": (True, "pinhole", np.zeros(8)),
    "orthographic": (False, "pinhole", np.zeros(8)),
    "brown-conrady": (True, "brown-conrady", np.array([-0.2, 0.07, 0.02, -0.03, 0.04, 0.1, -0.05, 0.03])),
    "fisheye": (True, "fisheye", np.array([-0.05, 0.04, -0.02, 0.01, 0, 0, 0, 0])),
}
lenses = pytest.mark.parametrize("lens", LENSES)


def test_cross_vjp():
    check_vjp(lambda a, b: np.array(pieces.cross(a, b)), pieces.cross_vjp, [random(3), random(3, seed=2)])


def test_dot_vjp():
    check_vjp(lambda a, b: np.array(pieces.dot(a, b)), pieces.dot_vjp, [random(3), random(3, seed=2)])


@lenses
@pytest.mark.parametrize(
    "q", [[0.4, -0.7, 2.3], [-0.3, 0.1, 0.4], [0.0, 0.0, 1.3]], ids=["within", "aside", "on the axis"]
)
def test_project_vjp(lens, q):
    perspective, name, distortion = LENSES[lens]

    def forward(q, k, d):
        return np.array(pieces.project(kernel_camera(k, perspective, name, d), q))

    def vjp(q, k, d, bar):
        return pieces.project_vjp(kernel_camera(k, perspective, name, d), q, bar)

    check_vjp(forward, vjp, [np.array(q), K6, distortion])


@lenses
def test_normalised_vjp(lens):
    """In K and the distortion; a pixel position is where one looks, and has no derivative."""
    x = np.array([11.3, 40.2])
    perspective, name, distortion = LENSES[lens]

    def forward(k, d):
        return np.array(pieces.normalised(kernel_camera(k, perspective, name, d), x))

    def vjp(k, d, bar):
        return pieces.normalised_vjp(kernel_camera(k, perspective, name, d), x, bar)

    check_vjp(forward, vjp, [K6, distortion])


@lenses
def test_bend_jvp_and_area_scale(lens):
    """Of the straight image, against differences of the positions in the image."""
    perspective, name, distortion = LENSES[lens]
    camera, pinhole = kernel_camera(K6, perspective, name, distortion), kernel_camera(K6, perspective)
    u = np.array(pieces.project(pinhole, [0.2, -0.3, 0.9]))

    def bent(u):
        return np.array(pieces.bend(camera, u, [0.0, 0.0])[0])

    J = np.stack([(bent(u + h) - bent(u - h)) / 2e-4 for h in 1e-4 * np.eye(2)], 1)
    tangent = np.array([0.7, -1.9])
    _, area_scale, along = pieces.bend(camera, u, tangent)
    np.testing.assert_allclose(along, J @ tangent, rtol=1e-7)
    np.testing.assert_allclose(area_scale, np.linalg.det(J), rtol=1e-7)


def seen_at(perspective: bool, n: np.ndarray, depth: float) -> np.ndarray:
    """The point at a depth that is seen at normalised image coordinates."""
    return np.array([*(depth * n if perspective else n), depth])


@lenses
@pytest.mark.parametrize("x", [[11.3, 40.2], [33.0, 25.0], [0.0, 0.0], [64.0, 48.0]], ids=str)
def test_normalised_and_project_are_inverse(lens, x):
    perspective, name, distortion = LENSES[lens]
    camera = kernel_camera(K6, perspective, name, distortion)
    n = np.array(pieces.normalised(camera, x))
    for depth in (0.5, 3.0):
        np.testing.assert_allclose(pieces.project(camera, seen_at(perspective, n, depth)), x, rtol=1e-13, atol=1e-12)


N = np.array([0.03, -0.12])  # inside the image of the triangle below
TRIANGLE = np.array([[-1.0, -0.8, 2.1], [1.2, -0.7, 2.9], [0.1, 1.3, 2.4]])


@perspective
def test_barycentrics_are_those_of_the_point_on_the_ray(perspective):
    met, (u, v) = pieces.barycentrics(pieces.face_map(kernel_camera(K6, perspective), TRIANGLE), N)
    point = (1 - u - v) * TRIANGLE[0] + u * TRIANGLE[1] + v * TRIANGLE[2]
    assert met and min(u, v, 1 - u - v) > 0
    np.testing.assert_allclose(point, seen_at(perspective, N, point[2]), atol=1e-14)


@perspective
@pytest.mark.parametrize("degenerate", ["segment", "point", "edge-on"])
def test_barycentrics_say_when_there_is_no_point(perspective, degenerate):
    n = np.array([0.25, -0.125])
    ray = np.stack([seen_at(perspective, n, depth) for depth in (1.0, 2.0, 4.0)])
    triangle = {"segment": TRIANGLE[[0, 0, 1]], "point": TRIANGLE[[2, 2, 2]], "edge-on": ray}[degenerate]
    assert not pieces.barycentrics(pieces.face_map(kernel_camera(K6, perspective), triangle), n)[0]


@perspective
def test_face_map_vjp(perspective):
    camera = kernel_camera(K6, perspective)

    def forward(triangle):
        return np.array(pieces.face_map(camera, triangle))

    check_vjp(forward, lambda triangle, bar: [pieces.face_map_vjp(camera, triangle, bar)], [TRIANGLE])


@perspective
def test_barycentrics_vjp(perspective):
    face_map = np.array(pieces.face_map(kernel_camera(K6, perspective), TRIANGLE))
    check_vjp(lambda m, n: np.array(pieces.barycentrics(m, n)[1]), pieces.barycentrics_vjp, [face_map, N])


def check_jvp(jvp: Arrays | np.ndarray, vjp: Arrays, tangents: Arrays, bar: np.ndarray) -> None:
    """⟨bar, J u⟩ = ⟨Jᵀ bar, u⟩."""
    products = [float(np.sum(np.asarray(b) * u)) for b, u in zip(vjp, tangents, strict=True)]
    np.testing.assert_allclose(np.sum(bar * np.asarray(jvp)), sum(products), rtol=1e-12)


@lenses
def test_forward_mode_is_the_adjoint(lens):
    perspective, name, distortion = LENSES[lens]
    camera = kernel_camera(K6, perspective, name, distortion)
    q, x = np.array([0.4, -0.7, 2.3]), np.array([11.3, 40.2])
    q_dot, k_dot, bar = random(3), random(14, seed=2), random(2, seed=3)
    intrinsics_dot = [k_dot[:6], k_dot[6:]]
    vjp = pieces.project_vjp(camera, q, bar)
    check_jvp(pieces.project_jvp(camera, q, q_dot, k_dot), vjp, [q_dot, *intrinsics_dot], bar)
    check_jvp(pieces.normalised_jvp(camera, x, k_dot), pieces.normalised_vjp(camera, x, bar), intrinsics_dot, bar)
    moved, map_bar = random(3, 3, seed=4), random(3, 3, seed=5)
    vjp = [pieces.face_map_vjp(camera, TRIANGLE, map_bar)]
    check_jvp(pieces.face_map_jvp(camera, TRIANGLE, moved), vjp, [moved], map_bar)
    face_map, n_dot = np.array(pieces.face_map(camera, TRIANGLE)), random(2, seed=6)
    vjp = pieces.barycentrics_vjp(face_map, N, bar)
    check_jvp(pieces.barycentrics_jvp(face_map, N, map_bar, n_dot), vjp, [map_bar, n_dot], bar)


def test_check_rejects_a_wrong_vjp():
    def forward(a, b):
        return np.array(pieces.cross(a, b))

    def swapped(a, b, bar):
        return pieces.cross_vjp(b, a, bar)

    def half_a_percent_off(a, b, bar):
        return [1.005 * np.array(g) for g in pieces.cross_vjp(a, b, bar)]

    def one_entry_missing(a, b, bar):
        return [np.array(g) * [1, 1, 0] for g in pieces.cross_vjp(a, b, bar)]

    for wrong in (swapped, half_a_percent_off, one_entry_missing):
        with pytest.raises(AssertionError):
            check_vjp(forward, wrong, [random(3), random(3, seed=2)])


def test_inside_keeps_what_is_inside():
    for u, v in [(0.2, 0.3), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.25, 0.75)]:
        assert pieces.inside(u, v) == [u, v]


@pytest.mark.parametrize("u, v", [(-0.1, 0.4), (0.3, -1e9), (0.8, 0.9), (1e300, 1e-3), (-1.0, -1.0), (2.0, -0.5)])
def test_inside_moves_to_the_rim(u, v):
    a, b = pieces.inside(u, v)
    assert a >= 0 and b >= 0 and a + b <= 1 + 1e-15
    assert min(a, b, 1 - a - b) <= 1e-15  # on the rim, to rounding


# -- textures ---------------------------------------------------------------------------------------------------------


def texels(height: int = 4, width: int = 5, channels: int = 3) -> np.ndarray:
    return random(height, width, channels, seed=3)


def texel_centre(row: int, column: int, height: int, width: int) -> tuple[float, float]:
    return (column + 0.5) / width, 1 - (row + 0.5) / height


def test_texture_has_its_texels_at_their_centres():
    """Row 0 on top, where v is largest; repeated on all sides."""
    texture = texels()
    for row, column in np.ndindex(texture.shape[:2]):
        u, v = texel_centre(row, column, 4, 5)
        for i, j in [(0, 0), (1, -2), (-3, 5)]:
            np.testing.assert_allclose(pieces.texture_eval(texture, [u + i, v + j]), texture[row, column], atol=1e-13)


def test_texture_is_linear_between_texels():
    texture = texels()
    u, v = texel_centre(1, 2, 4, 5)
    value = pieces.texture_eval(texture, [u + 0.25 / 5, v - 0.6 / 4])  # a quarter to the right, 0.6 down
    upper = 0.75 * texture[1, 2] + 0.25 * texture[1, 3]
    lower = 0.75 * texture[2, 2] + 0.25 * texture[2, 3]
    np.testing.assert_allclose(value, 0.4 * upper + 0.6 * lower, rtol=1e-13)


@pytest.mark.parametrize("uv", [(0.33, 0.71), (0.02, 0.97), (-1.37, 2.11), (0.995, 0.005)])
@pytest.mark.parametrize("shape", [(4, 5, 3), (1, 1, 2), (1, 7, 1), (3, 1, 20)])
def test_texture_eval_vjp(uv, shape):
    def forward(texture, uv):
        return np.array(pieces.texture_eval(texture, uv))

    def vjp(texture, uv, bar):
        uv_bar, rows, weights = pieces.texture_eval_vjp(texture, uv, bar)
        texture_bar = np.zeros((texture.shape[0] * texture.shape[1], texture.shape[2]))
        np.add.at(texture_bar, rows, np.outer(weights, bar))
        return texture_bar.reshape(texture.shape), uv_bar

    check_vjp(forward, vjp, [texels(*shape), np.array(uv)])


def test_texture_far_out():
    """Beyond what an integer holds a coordinate has no fraction left, and must still find a texel."""
    for uv in ([1e30, 0.5], [-1e30, 1e25], [2.0**62, -(2.0**63)]):
        assert np.isfinite(pieces.texture_eval(texels(), uv)).all()


# -- the pixel filter -------------------------------------------------------------------------------------------------

GAUSSIAN_INSIDE = erf(3 / np.sqrt(2))  # of a Gaussian within 3 σ = 1.5 px

# The cumulative weight from the left end, written out.
CUMULATIVE = {
    "box": lambda x: x + 0.5,
    "tent": lambda x: np.where(x < 0, 0.5 * (1 + x) ** 2, 1 - 0.5 * (1 - x) ** 2),
    "gaussian": lambda x: 0.5 + 0.5 * erf(np.sqrt(2) * x) / GAUSSIAN_INSIDE,
}
RADIUS = {"box": 0.5, "tent": 1.0, "gaussian": 1.5}
filters = pytest.mark.parametrize("name", list(RADIUS))


@filters
def test_filter_weight(name):
    """It is the density of the cumulative weight, one in all, and zero beyond the radius."""
    radius = pieces.filter_radius(name)
    assert radius == RADIUS[name]
    assert pieces.filter_weight(name, radius + 1e-9) == pieces.filter_weight(name, -radius - 1e-9) == 0
    # Gauss-Legendre with 20 points on either side of the kink in the middle: exact to rounding.
    x, w = np.polynomial.legendre.leggauss(20)
    for end in np.linspace(-radius, radius, 7)[1:]:
        mass = 0.0
        for low, high in [(-radius, min(end, 0.0)), (0.0, end)]:
            if high > low:
                points = low + 0.5 * (x + 1) * (high - low)
                mass += (
                    0.5
                    * (high - low)
                    * sum(wi * pieces.filter_weight(name, p) for p, wi in zip(points, w, strict=True))
                )
        assert mass == pytest.approx(CUMULATIVE[name](end), abs=1e-13)


@filters
def test_filter_sample_agrees_with_its_weight(name):
    """The sample at u leaves the share u of the weight on its left, so samples are distributed as the weight."""
    u = np.concatenate([[2.0**-54, 1e-12, 1e-6], (np.arange(999) + 0.5) / 999, [1 - 1e-6, 1 - 1e-12, 1 - 2.0**-53]])
    x = np.array([pieces.filter_sample(name, ui) for ui in u])
    assert np.all(np.abs(x) <= RADIUS[name]) and np.all(np.diff(x) >= 0)
    np.testing.assert_allclose(CUMULATIVE[name](x), u, atol=1e-13)  # what Newton's steps on erf promise
    np.testing.assert_allclose(x, -x[::-1], atol=1e-6)  # symmetric; at 1 - 1e-12 u itself is rounded to 1e-16


# -- sample points ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "points", [pieces.lattice, pieces.sequence, pieces.sobol], ids=["lattice", "sequence", "sobol"]
)
class TestPoints:
    def test_lie_in_the_unit_square(self, points):
        for n, seed in itertools.product([1, 2, 7, 64, 1000], [0, 1, 2**63 - 1]):
            x = np.array(points(seed, n))
            assert x.shape == (n, 2) and (x >= 0).all() and (x < 1).all()

    def test_means_are_unbiased(self, points):
        """Over 4,000 random shifts, within 4 standard errors, for each point alone and for both axes together."""
        x = np.array([points(seed, 5) for seed in range(1, 4001)])  # (shift, point, axis)
        for f in (
            lambda x, y: x,
            lambda x, y: y,
            lambda x, y: x * y,
            lambda x, y: x > 0.9,
            lambda x, y: np.abs(x - y) < 0.1,
        ):
            value = f(x[..., 0], x[..., 1]).astype(float)
            grid = (np.arange(2000) + 0.5) / 2000
            expected = np.mean(f(grid[:, None], grid[None, :]))
            assert (
                np.abs(value.mean(0) - expected) < 4 * value.std(0) / np.sqrt(len(x)) + 1e-3 * (expected == 0)
            ).all()

    def test_are_spread_evenly(self, points):
        """The error of a mean over 256 points is a small part of that of independent ones."""

        def f(x):
            return np.sin(2 * np.pi * (x[..., 0] + 0.1)) * np.cos(2 * np.pi * x[..., 1]) + (x[..., 0] * x[..., 1] < 0.2)

        x = np.array([points(seed, 256) for seed in range(1, 101)])
        independent = f(x).std() / 16
        assert f(x).mean(1).std() < 0.3 * independent


def test_lattice_is_regular_along_x():
    x = np.sort(np.array(pieces.lattice(5, 16))[:, 0])
    np.testing.assert_allclose(np.diff(x), 1 / 16, atol=1e-12)


@pytest.mark.parametrize("first", [0, 64, 3 * 2**20, 2**32 - 64])
@pytest.mark.parametrize("m", [1, 2, 4, 6])
def test_runs_of_sobol_fill_boxes(m, first):
    """2^m points from a multiple of 2^m on: one in each of the boxes of any shape 2^−a × 2^(a−m)."""
    for seed in (1, 2, 77):
        x = np.array(pieces.sobol(seed, 2**m, first))
        for a in range(m + 1):
            box = np.floor(x * [2**a, 2 ** (m - a)]).astype(int)
            assert len({tuple(b) for b in box}) == 2**m


def test_scrambles_are_independent():
    """Two points in different halves of the square, over 4,000 scrambles: any two places within their halves are as likely."""
    x = np.array([pieces.sobol(seed, 2) for seed in range(4000)])
    assert ((x[:, 0] < 0.5) != (x[:, 1] < 0.5)).all()
    folded = 2 * x % 1 < 0.5  # in which quarter of its half
    for i, j in itertools.combinations(range(4), 2):
        both = np.mean(folded.reshape(-1, 4)[:, i] == folded.reshape(-1, 4)[:, j])
        assert abs(both - 0.5) < 4 * 0.5 / np.sqrt(4000)


def test_z_order_counts_blocks():
    """Squares of 2^k pixels have consecutive numbers; far pixels do not overflow."""
    found = np.array([[pieces.z_order(x, y) for x in range(16)] for y in range(16)])
    for k in range(5):
        blocks = found.reshape(16 >> k, 1 << k, 16 >> k, 1 << k).transpose(0, 2, 1, 3).reshape(-1, 4**k)
        assert (np.sort(blocks, 1) == blocks.min(1, keepdims=True) + np.arange(4**k)).all()
        assert (blocks.min(1) % 4**k == 0).all()
    assert pieces.z_order(2**31 - 1, 0) == int("01" * 31, 2)
    assert pieces.z_order(0, 2**31 - 1) == 2 * int("01" * 31, 2)


def test_shifts_differ():
    for points in (pieces.lattice, pieces.sequence, pieces.sobol):
        assert len({x for seed in range(1, 101) for x in points(seed, 1)[0]}) == 200


# -- systematic sampling ----------------------------------------------------------------------------------------------

MEASURES = {
    "few": np.array([0.0, 3.0, 0.0, 0.0, 1.0, 0.5, 0.0]),
    "wide range": 10.0 ** np.arange(-9, 6),
    "more than a block": np.abs(random(10_000, seed=4)) * (random(10_000, seed=5) > 0),  # sums run in blocks of 4096
    "one": np.array([2.5]),
}
measures = pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)
SHIFTS = [2.0**-54, 0.1, 0.5, 0.77, 1 - 2.0**-53]


@measures
@pytest.mark.parametrize("n", [1, 100, 30_000])
def test_systematic_counts_are_proportional(measure, n):
    """A run of primitives gets its share to within one point, and each point weighs 1 / density."""
    total = measure.sum()
    for shift in SHIFTS:
        which, weight = map(np.array, zip(*pieces.systematic(measure, n, shift), strict=True))
        assert (np.diff(which) >= 0).all()
        count = np.bincount(which, minlength=len(measure))
        assert (count[measure == 0] == 0).all()
        share = n * measure / total
        assert (np.abs(count - share) < 1 + 1e-9 * share).all()
        assert (np.abs(np.cumsum(count) - np.cumsum(share)) < 1 + 1e-9 * n).all()
        # The running sum rounds a measure by ε · total, which is what 1e-15 · total / measure allows for.
        np.testing.assert_array_less(
            np.abs(weight * measure[which] * n / total - 1), 1e-12 + 1e-15 * total / measure[which]
        )
        assert np.sum(weight * measure[which]) == pytest.approx(total, rel=1e-6)


@measures
def test_systematic_is_unbiased(measure):
    """Over all shifts the expected weight of each primitive is one."""
    n, shifts = 3, 2000
    expected = np.zeros(len(measure))
    for i in range(shifts):
        for k, weight in pieces.systematic(measure, n, (i + 0.5) / shifts):
            expected[k] += weight / shifts
    # 6,000 equally spaced points count a share s to within one: 1 / (6,000 s). Where that is no test, it is left out.
    share = measure / measure.sum()
    seen = share * n * shifts > 2
    np.testing.assert_array_less(np.abs(expected - 1)[seen], 1.01 / (share * n * shifts)[seen] + 1e-9)
    assert (expected[measure == 0] == 0).all()


# -- importance -------------------------------------------------------------------------------------------------------

CELL = 1 / 256  # importance is counted in 256ths, so that its sums are exact


def adjoint_image(kind: str, height: int = 11, width: int = 17, channels: int = 2) -> np.ndarray:
    image = random(height, width, channels, seed=6)
    if kind == "sparse":
        image *= (random(height, width, 1, seed=7) > 1.0).astype(float)
    if kind == "wide range":
        image *= np.exp(8 * random(height, width, 1, seed=8))
    return image


def reached(image: np.ndarray, radius: float, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """The pixels that meet the rectangle widened by the radius."""
    x0, x1 = (int(np.floor(v)) for v in (low[0] - radius, high[0] + radius))
    y0, y1 = (int(np.floor(v)) for v in (low[1] - radius, high[1] + radius))
    return image[max(y0, 0) : max(y1 + 1, 0), max(x0, 0) : max(x1 + 1, 0)]


def rectangles(count: int = 60) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(9)
    corners = generator.uniform([-4, -4], [21, 15], size=(count, 2, 2))
    corners[: count // 3, 1] = corners[: count // 3, 0]  # points
    return [(c.min(0), c.max(0)) for c in corners]


@pytest.mark.parametrize("kind", ["dense", "sparse", "wide range"])
@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0])
def test_importance_is_the_mean_of_its_pixels(kind, radius):
    """1 + 8 |A| / mean where there is an adjoint, rounded down to 256ths pixel by pixel; sums of them are exact."""
    image = adjoint_image(kind)
    size = np.abs(image).sum(-1)
    formula = np.where(size > 0, 1 + 8 * size / size[size > 0].mean(), 0)
    pixel = np.array(
        [
            [pieces.importance(image, 0.0, [x + 0.5, y + 0.5], [x + 0.5, y + 0.5]) for x in range(image.shape[1])]
            for y in range(image.shape[0])
        ]
    )
    assert (pixel <= formula).all() and (pixel > formula - CELL).all()
    for low, high in rectangles():
        part = reached(pixel, radius, low, high)
        expected = part.sum() / part.size if part.size else 0.0
        assert pieces.importance(image, radius, low, high) == expected


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0])
def test_importance_is_zero_only_where_no_adjoint_is(radius):
    image = adjoint_image("sparse") * 1e-30
    image[3, 4] = [0, 5e-324]
    image[7, 2] = [1e30, 0]
    seen = set()
    for low, high in rectangles(200):
        any_adjoint = bool((reached(image, radius, low, high) != 0).any())
        assert (pieces.importance(image, radius, low, high) > 0) == any_adjoint
        seen.add(any_adjoint)
    assert seen == {True, False}


@filters
def test_importance_reaches_as_far_as_the_filter(name):
    """A single pixel with an adjoint: wherever its filter has weight, the importance is not zero."""
    image = np.zeros((11, 17, 1))
    image[5, 8] = -2.0
    radius = pieces.filter_radius(name)
    for dx, dy in itertools.product(np.linspace(-2.4, 2.4, 25), repeat=2):
        x = [8.5 + dx, 5.5 + dy]
        weight = pieces.filter_weight(name, dx) * pieces.filter_weight(name, dy)
        importance = pieces.importance(image, radius - 0.5, x, x)
        # On its own border the box belongs to one pixel only; everywhere else weight means importance.
        if weight > 0 and not (name == "box" and max(abs(dx), abs(dy)) == 0.5):
            assert importance > 0
        if max(abs(dx), abs(dy)) > radius + 1:
            assert importance == 0


def test_importance_of_no_adjoint():
    assert pieces.importance(np.zeros((3, 4, 3)), 0.5, [0.0, 0.0], [4.0, 3.0]) == 0


# -- edges ------------------------------------------------------------------------------------------------------------

EPS32, EPS64 = 2.0**-23, 2.0**-52


def edges_of(verts: torch.Tensor, faces: torch.Tensor, spacing: float = EPS64) -> list[list[tuple[int, int, bool]]]:
    """The edges, each a list of its half-edges (face, corner where it begins, whether against the edge)."""
    return pieces.edges(verts.double().numpy(), faces.int().numpy(), [0], [spacing])


def faces_at(edges: list[list[tuple[int, int, bool]]]) -> list[int]:
    """How many faces the edges have, sorted."""
    return sorted(len(edge) for edge in edges)


def check_ends(
    verts: torch.Tensor, faces: torch.Tensor, edges: list[list[tuple[int, int, bool]]], atol: float = 0
) -> None:
    """All half-edges of an edge run between the same two places; the first one gives its direction."""
    for edge in edges:
        ends = []
        for face, corner, backwards in edge:
            pair = verts[faces[face].roll(-corner)[:2]].double()
            ends.append(pair.flip(0) if backwards else pair)
        assert not edge[0][2]
        for pair in ends:
            torch.testing.assert_close(pair, ends[0], rtol=0, atol=atol)


def split(verts: torch.Tensor, faces: torch.Tensor, groups: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices copied, so that faces of different groups (F,) share none."""
    pairs, index = torch.unique(
        torch.stack([groups[:, None].expand(-1, 3), faces], -1).reshape(-1, 2), dim=0, return_inverse=True
    )
    return verts[pairs[:, 1]], index.reshape(-1, 3)


def rotation32() -> torch.Tensor:
    """An oblique rotation in float32."""
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -0.6, 0.3], [0.6, 0.0, -0.8], [-0.3, 0.8, 0.0]]))


CUBE = cube()
ONE_QUAD = torch.arange(12) // 2  # faces 2 i and 2 i + 1 make a side of the cube


@pytest.mark.parametrize(
    "groups, verts",
    [(torch.zeros(12, dtype=torch.int64), 8), (ONE_QUAD, 24), (torch.arange(12), 36)],
    ids=["welded", "split at its edges", "soup"],
)
def test_cube_has_18_edges(groups, verts):
    """12 edges and 6 diagonals, each with two faces, however often the vertices are repeated."""
    v, f = split(CUBE.verts, CUBE.faces, groups)
    assert len(v) == verts
    edges = edges_of(v, f)
    assert faces_at(edges) == [2] * 18
    check_ends(v, f, edges)
    # The surface is oriented, so the two faces of an edge run along it in opposite directions.
    assert all(edge[0][2] != edge[1][2] for edge in edges)


def test_edges_come_in_the_order_of_the_faces():
    """However the vertices are numbered: neighbouring edges are neighbours in memory where faces are."""
    faces = torch.tensor([[7, 2, 5], [5, 2, 0], [0, 2, 6]])
    edges = edges_of(torch.eye(8)[:, :3] + torch.arange(8)[:, None], faces)
    sides = [{int(faces[f, c]), int(faces[f, (c + 1) % 3])} for ((f, c, _), *_) in edges]
    # By the vertex that comes first, and those of one vertex by the other: 7, 2, 5, 0, 6.
    assert sides == [{7, 2}, {7, 5}, {2, 5}, {2, 0}, {2, 6}, {5, 0}, {0, 6}]


def test_half_edges_cover_every_side_once():
    mesh = icosphere(2)
    edges = edges_of(mesh.verts, mesh.faces)
    assert faces_at(edges) == [2] * (3 * len(mesh.faces) // 2)
    sides = sorted((face, corner) for edge in edges for face, corner, _ in edge)
    assert sides == [(f, c) for f in range(len(mesh.faces)) for c in range(3)]


def test_border_and_three_faces_on_one_edge():
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, -1]])
    faces = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    edges = edges_of(verts, faces)
    assert faces_at(edges) == [1] * 6 + [3]
    shared = next(edge for edge in edges if len(edge) == 3)
    assert sorted(face for face, _, _ in shared) == [0, 1, 2]
    assert {face: backwards for face, _, backwards in shared} == {0: False, 1: True, 2: False}
    soup, index = split(verts, faces, torch.arange(3))
    assert faces_at(edges_of(soup, index)) == [1] * 6 + [3]


def test_faces_that_repeat_a_vertex_are_ignored():
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 0]])
    good = torch.tensor([[0, 1, 2], [1, 3, 2]])
    bad = torch.tensor([[0, 0, 1], [2, 2, 2], [3, 1, 3]])
    assert faces_at(edges_of(verts, torch.cat([good, bad]))) == faces_at(edges_of(verts, good)) == [1] * 4 + [2]
    assert edges_of(verts, bad) == []
    # A face may also repeat a place by way of a copy of its vertex: 4 lies on 0.
    assert faces_at(edges_of(verts, torch.cat([good, torch.tensor([[0, 4, 1]])]))) == [1] * 4 + [2]


@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (1e-4, 0.0), (1e4, 0.0), (1.0, 50.0)])
def test_rotated_soup_welds(scale, shift):
    """A user's own matrix product may round the copies of a vertex differently, by some float32 spacings."""
    mesh = icosphere(3)
    soup, index = split(scale * mesh.verts.float(), mesh.faces, torch.arange(len(mesh.faces)))
    moved = soup @ rotation32().mT + scale * shift
    edges = edges_of(moved, index, EPS32)
    assert faces_at(edges) == [2] * (3 * len(mesh.faces) // 2)
    check_ends(moved, index, edges, atol=8 * EPS32 * float(moved.abs().max()))


def test_copies_off_by_roundings_weld_at_their_own_precision_only():
    """The same positions, once as float32 numbers and once as float64 numbers that mean to be apart."""
    soup, index = split(CUBE.verts, CUBE.faces, torch.arange(12))
    noise = torch.from_numpy(random(len(soup), 3, seed=10)).clamp(-1, 1)
    moved = soup + 0.6 * EPS32 * noise
    assert faces_at(edges_of(moved, index, EPS32)) == [2] * 18
    assert faces_at(edges_of(moved, index, EPS64)) == [1] * 36


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 100 * EPS32])
def test_near_vertices_do_not_weld(gap):
    """Two triangles side by side with a slit between them, 100 spacings wide or more."""
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    b = torch.tensor([[1.0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
    faces = torch.arange(6).reshape(2, 3)
    assert faces_at(edges_of(torch.cat([a, b]), faces, EPS32)) == [1] * 4 + [2]
    assert faces_at(edges_of(torch.cat([a, b + gap]), faces, EPS32)) == [1] * 6


def test_vertices_inside_a_closed_surface_do_not_weld():
    """Two cubes that share a side by position are closed each by itself: no edge gets four faces."""
    verts = torch.cat([CUBE.verts, CUBE.verts + torch.tensor([1.2, 0.0, 0.0])])
    faces = torch.cat([CUBE.faces, CUBE.faces + 8])
    assert faces_at(edges_of(verts, faces)) == [2] * 36


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
def test_splats_and_their_adjoint(filter: str) -> None:
    """⟨bar, splat(values)⟩ = ⟨splat_vjp(bar), values⟩, and what is spread sums to the filter's weights in the image."""
    x, values, bar = 12 * random(200, 2) + 6, random(200, 3, seed=2), random(12 * 9, 3, seed=3)
    found = core.splat(x, values, filter, 12, 9)
    back = core.splat_vjp(x, bar, filter, 12, 9, 2)
    assert np.sum(bar * found) == pytest.approx(np.sum(back * values), rel=1e-12)
    inside = (np.abs(x - [6, 4.5]) < [4, 2.5]).all(1)
    weights = core.splat(x[inside], values[inside], filter, 12, 9).sum(0)
    spread = {"box": 0, "tent": 1e-12, "gaussian": 0.05}[filter]  # pixel centres do not sum a Gaussian exactly
    np.testing.assert_allclose(weights, values[inside].sum(0), atol=spread * np.abs(values[inside]).sum() + 1e-12)
    single = core.splat_vjp(x, bar.astype(np.float32), filter, 12, 9, 1)
    np.testing.assert_allclose(single, back, atol=1e-6)
