"""Adjoints of the kernel's small functions: products, projections, lenses, barycentrics."""

from __future__ import annotations

import numpy as np
import pytest
from adjoints import Arrays, check_vjp, random
from kernel_parts import parts

from edgegrad.library import core

pytestmark = [pytest.mark.quick, pytest.mark.watched]

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
    check_vjp(lambda a, b: np.array(parts.cross(a, b)), parts.cross_vjp, [random(3), random(3, seed=2)])


def test_dot_vjp():
    check_vjp(lambda a, b: np.array(parts.dot(a, b)), parts.dot_vjp, [random(3), random(3, seed=2)])


@lenses
@pytest.mark.parametrize(
    "q", [[0.4, -0.7, 2.3], [-0.3, 0.1, 0.4], [0.0, 0.0, 1.3]], ids=["within", "aside", "on the axis"]
)
def test_project_vjp(lens, q):
    perspective, name, distortion = LENSES[lens]

    def forward(q, k, d):
        return np.array(parts.project(kernel_camera(k, perspective, name, d), q))

    def vjp(q, k, d, bar):
        return parts.project_vjp(kernel_camera(k, perspective, name, d), q, bar)

    check_vjp(forward, vjp, [np.array(q), K6, distortion])


@lenses
def test_normalised_vjp(lens):
    """K and the distortion have derivatives; a pixel position is given, and has none."""
    x = np.array([11.3, 40.2])
    perspective, name, distortion = LENSES[lens]

    def forward(k, d):
        return np.array(parts.normalised(kernel_camera(k, perspective, name, d), x))

    def vjp(k, d, bar):
        return parts.normalised_vjp(kernel_camera(k, perspective, name, d), x, bar)

    check_vjp(forward, vjp, [K6, distortion])


@lenses
def test_distortion_jvp_and_area_scale(lens):
    """Compare derivatives by the undistorted image with differences of the positions in the image."""
    perspective, name, distortion = LENSES[lens]
    camera, pinhole = kernel_camera(K6, perspective, name, distortion), kernel_camera(K6, perspective)
    u = np.array(parts.project(pinhole, [0.2, -0.3, 0.9]))

    def distorted_position(u):
        return np.array(parts.distort(camera, u, [0.0, 0.0])[0])

    J = np.stack([(distorted_position(u + h) - distorted_position(u - h)) / 2e-4 for h in 1e-4 * np.eye(2)], 1)
    tangent = np.array([0.7, -1.9])
    _, area_scale, along = parts.distort(camera, u, tangent)
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
    n = np.array(parts.normalised(camera, x))
    for depth in (0.5, 3.0):
        np.testing.assert_allclose(parts.project(camera, seen_at(perspective, n, depth)), x, rtol=1e-13, atol=1e-12)


N = np.array([0.03, -0.12])  # inside the image of the triangle below
TRIANGLE = np.array([[-1.0, -0.8, 2.1], [1.2, -0.7, 2.9], [0.1, 1.3, 2.4]])


@perspective
def test_barycentrics_are_those_of_the_point_on_the_ray(perspective):
    met, (u, v) = parts.barycentrics(parts.face_map(kernel_camera(K6, perspective), TRIANGLE), N)
    point = (1 - u - v) * TRIANGLE[0] + u * TRIANGLE[1] + v * TRIANGLE[2]
    assert met and min(u, v, 1 - u - v) > 0
    np.testing.assert_allclose(point, seen_at(perspective, N, point[2]), atol=1e-14)


@perspective
@pytest.mark.parametrize("degenerate", ["segment", "point", "edge-on"])
def test_barycentrics_say_when_there_is_no_point(perspective, degenerate):
    n = np.array([0.25, -0.125])
    ray = np.stack([seen_at(perspective, n, depth) for depth in (1.0, 2.0, 4.0)])
    triangle = {"segment": TRIANGLE[[0, 0, 1]], "point": TRIANGLE[[2, 2, 2]], "edge-on": ray}[degenerate]
    assert not parts.barycentrics(parts.face_map(kernel_camera(K6, perspective), triangle), n)[0]


@perspective
def test_face_map_vjp(perspective):
    camera = kernel_camera(K6, perspective)

    def forward(triangle):
        return np.array(parts.face_map(camera, triangle))

    check_vjp(forward, lambda triangle, bar: [parts.face_map_vjp(camera, triangle, bar)], [TRIANGLE])


@perspective
def test_barycentrics_vjp(perspective):
    face_map = np.array(parts.face_map(kernel_camera(K6, perspective), TRIANGLE))
    check_vjp(lambda m, n: np.array(parts.barycentrics(m, n)[1]), parts.barycentrics_vjp, [face_map, N])


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
    vjp = parts.project_vjp(camera, q, bar)
    check_jvp(parts.project_jvp(camera, q, q_dot, k_dot), vjp, [q_dot, *intrinsics_dot], bar)
    check_jvp(parts.normalised_jvp(camera, x, k_dot), parts.normalised_vjp(camera, x, bar), intrinsics_dot, bar)
    moved, map_bar = random(3, 3, seed=4), random(3, 3, seed=5)
    vjp = [parts.face_map_vjp(camera, TRIANGLE, map_bar)]
    check_jvp(parts.face_map_jvp(camera, TRIANGLE, moved), vjp, [moved], map_bar)
    face_map, n_dot = np.array(parts.face_map(camera, TRIANGLE)), random(2, seed=6)
    vjp = parts.barycentrics_vjp(face_map, N, bar)
    check_jvp(parts.barycentrics_jvp(face_map, N, map_bar, n_dot), vjp, [map_bar, n_dot], bar)


def test_check_rejects_a_wrong_vjp():
    def forward(a, b):
        return np.array(parts.cross(a, b))

    def swapped(a, b, bar):
        return parts.cross_vjp(b, a, bar)

    def half_a_percent_off(a, b, bar):
        return [1.005 * np.array(g) for g in parts.cross_vjp(a, b, bar)]

    def one_entry_missing(a, b, bar):
        return [np.array(g) * [1, 1, 0] for g in parts.cross_vjp(a, b, bar)]

    for wrong in (swapped, half_a_percent_off, one_entry_missing):
        with pytest.raises(AssertionError):
            check_vjp(forward, wrong, [random(3), random(3, seed=2)])


def test_inside_keeps_what_is_inside():
    for u, v in [(0.2, 0.3), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.25, 0.75)]:
        assert parts.inside(u, v) == [u, v]


@pytest.mark.parametrize("u, v", [(-0.1, 0.4), (0.3, -1e9), (0.8, 0.9), (1e300, 1e-3), (-1.0, -1.0), (2.0, -0.5)])
def test_inside_moves_to_the_border(u, v):
    a, b = parts.inside(u, v)
    assert a >= 0 and b >= 0 and a + b <= 1 + 1e-15
    assert min(a, b, 1 - a - b) <= 1e-15  # on the border, to rounding
