"""Terms of the tracker's likelihood against float64 oracles: values, and derivatives by finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kernel_parts import parts
from probes import (
    CAMERAS,
    POSE,
    gradient_of,
    in_kernel,
    on_surface,
    points,
    potato,
    probe,
    project,
    stepped,
    tells_apart,
)

REACH, SIDE, AMPLITUDE, SLOPE = 6, 5, 0.43, 0.7
SIZE = 120, 160


def test_a_step_is_a_rotation_about_the_centre_and_a_shift_in_sizes():
    d = np.array([0.3, -0.2, 0.5, 0.1, 0.05, -0.2])
    assert np.allclose(parts.track_stepped(POSE, d.tolist(), 1.7), stepped(POSE, d, 1.7), atol=1e-14)
    tiny = 1e-6 * d
    assert np.allclose(parts.track_stepped(POSE, tiny.tolist(), 1.7), stepped(POSE, tiny, 1.7), atol=1e-15)


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_and_its_derivative_with_every_lens(name):
    camera = CAMERAS[name]
    kernel, rng = in_kernel(camera), np.random.default_rng(1)
    for _ in range(20):
        q = np.array([*rng.uniform(-0.8, 0.8, 2), rng.uniform(2.5, 4.0)])
        row = parts.track_project(kernel, q.tolist())
        identity = np.eye(3, 4)
        assert np.allclose(row[:2], project(camera, q[None], identity)[0], atol=1e-8)
        for axis in range(2):
            slope = [(project(camera, q[None] + h * e, identity) - project(camera, q[None] - h * e, identity))[0, axis] / (2 * h)
                     for e in np.eye(3) for h in (1e-5,)]  # fmt: skip
            tells_apart(row[2 + 3 * axis : 5 + 3 * axis], np.array(slope), 1e-5)
        ray = parts.track_ray(kernel, row[:2].tolist())
        along = q - ray[:3]
        assert np.linalg.norm(np.cross(along, ray[3:])) < 1e-6 * np.linalg.norm(along) * np.linalg.norm(ray[3:])
        assert along @ ray[3:] > 0.0


def test_nothing_is_seen_behind_a_pinhole():
    assert parts.track_project(in_kernel(CAMERAS["perspective"]), [0.1, 0.2, -1.0]) is None
    panorama = CAMERAS["panorama"]
    wide = panorama.replace(
        size=(200, 400), K=panorama.K + torch.tensor([[0.0, 0.0, 120.0], [0.0, 0.0, 40.0], [0.0, 0.0, 0.0]])
    )
    assert parts.track_project(in_kernel(wide), [0.1, 0.2, -1.0]) is not None


def test_the_region_likelihood_is_the_product_over_segments():
    f = np.random.default_rng(2).uniform(0.02, 0.98, 2 * (REACH + SIDE) + 1)
    log, gain = parts.track_region(f.astype(np.float32))
    r = np.arange(-REACH - SIDE, REACH + SIDE + 1)
    expected = []
    for d in range(-REACH, REACH + 1):
        h = 0.5 - AMPLITUDE * np.tanh((r - d) / (2 * SLOPE))
        expected.append(np.log(h * f + (1 - h) * (1 - f)).sum())
    assert np.allclose(log, expected, atol=1e-4)
    sides = [np.log((0.5 + s * AMPLITUDE) * f + (0.5 - s * AMPLITUDE) * (1 - f)).sum() for s in (1, -1)]
    assert gain == pytest.approx(math.log(np.mean(np.exp(expected))) - max(sides), abs=1e-4)


def edge_oracle(I: np.ndarray, blur: float) -> np.ndarray:
    """Return the marginal likelihoods (2, 21) of both models by least squares: constants, and trends with a g-prior."""
    r, out = np.arange(-7.0, 8.0), []
    n, g = 7.0, 7.0
    for d in np.arange(-10, 11) * 0.25:
        x = r - d
        w = np.exp(-0.5 * (x / 3.0) ** 2)
        root = np.sqrt(w / w.sum() * n)[:, None]
        phi = np.array([0.5 * (1.0 + math.erf(v / blur / math.sqrt(2.0))) for v in x])
        columns = root * np.stack([1.0 - phi, phi, (1.0 - phi) * x, phi * x], 1)
        plain, trends = (
            float(((root * I - A @ np.linalg.lstsq(A, root * I, rcond=None)[0]) ** 2).sum())
            for A in (columns[:, :2], columns)
        )
        shrunk = plain - g / (1.0 + g) * (plain - trends)
        # Of 21 - 6 residuals 6 are independent; two columns of three channels cost (1 + g)^(-6/2) of as many.
        out.append([(plain + 1e-4) ** -3.0, (1.0 + g) ** (-3.0 * 6.0 / 15.0) * (shrunk + 1e-4) ** -3.0])
    return np.array(out).T


@pytest.mark.parametrize("moving", [False, True])
def test_the_edge_likelihood_is_the_marginal_one(moving):
    rng, prior = np.random.default_rng(3), np.array([0.7, 0.3])
    for trend in (0.0, 0.03):
        r = np.arange(-7.0, 8.0)
        phi = np.array([0.5 * (1.0 + math.erf((v - 0.6) / 0.85 / math.sqrt(2.0))) for v in r])[:, None]
        I = (np.array([0.6, 0.3, 0.2]) + trend * r[:, None]) * (1 - phi) + np.array([0.2, 0.5, 0.3]) * phi
        I = I + 0.01 * rng.normal(size=I.shape)
        given = np.concatenate([I, np.zeros((15, 1))], 1).astype(np.float32)
        expected = prior[:, None] * (edge_oracle(I, 0.85) + (edge_oracle(I, 2.0) if moving else 0.0))
        found, shares = parts.track_edge(given, moving, prior.tolist())
        assert np.allclose(found, expected.sum(0), rtol=5e-3)
        assert np.allclose(shares, expected.sum(1) / expected.sum(), atol=2e-3)
        p = found / found.sum()
        assert abs(p @ (np.arange(-10, 11) * 0.25) - 0.6) < 0.15


@pytest.mark.parametrize("name", CAMERAS)
def test_points_lie_on_the_contour_with_normals_outwards(name):
    camera, mesh = CAMERAS[name], potato()
    rows = probe(camera, mesh).contour()
    V, F = mesh
    X, x, n = rows[:, :3], rows[:, 3:5], rows[:, 5:7]
    assert 100 < len(rows) <= 200 and np.allclose(np.linalg.norm(n, axis=1), 1.0)
    assert np.allclose(x, project(camera, X, POSE), atol=1e-6)
    # The image of the body is that of its faces: a point 0.7 px outside lies in none, and one 1.5 px inside in some.
    corners = project(camera, V, POSE)[F]

    def covered(p: np.ndarray) -> np.ndarray:
        d = corners[None] - p[:, None, None]
        cross = [d[:, :, k, 0] * d[:, :, k - 2, 1] - d[:, :, k, 1] * d[:, :, k - 2, 0] for k in range(3)]
        signs = np.sign(np.stack(cross))
        return (np.abs(signs.sum(0)) == 3).any(1)

    assert not covered(x + 0.7 * n).any()
    assert covered(x - 1.5 * n).mean() > 0.98
    # Points are spread over the whole outline.
    angle = np.sort(np.arctan2(*(x - x.mean(0)).T))
    assert np.diff(angle).max() < 0.2


@pytest.mark.parametrize("name", CAMERAS)
def test_lines_pull_as_the_contour_moves(name):
    """With all lines at distance zero, the system at a moved pose is that of the points' motion along their normals."""
    camera, mesh = CAMERAS[name], potato()
    one = probe(camera, mesh)
    rows = one.contour()
    image = np.zeros((*SIZE, 3), np.float32)
    one.read(image + 0.5)
    one.learn()
    measured = one.measure(1, False)
    X, x, n = rows[:, :3], rows[:, 3:5], rows[:, 5:7]
    rng = np.random.default_rng(5)
    # A picture of two colours, whose edge is the outline itself.
    corners = project(camera, mesh[0], POSE)[mesh[1]]
    yy, xx = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    inside = np.zeros(SIZE, bool)
    for c in corners:
        d = [c[k] - np.stack([xx, yy], -1) for k in range(3)]
        s = np.stack([d[k][..., 0] * d[k - 2][..., 1] - d[k][..., 1] * d[k - 2][..., 0] for k in range(3)])
        inside |= (s >= 0).all(0) | (s <= 0).all(0)
    image[inside], image[~inside] = (0.6, 0.1, 0.1), (0.1, 0.2, 0.6)
    one.read(image + 0.01 * rng.random(image.shape).astype(np.float32))
    one.learn()
    measured = one.measure(1, True)
    mean, variance, gain, share = measured.T
    assert (gain > 0.5).mean() > 0.95 and np.abs(mean).mean() < 0.4

    def pull(pose: np.ndarray, cauchy: float) -> float:
        # Minus the log-likelihood of Cauchy's distribution with this scale about each line's normal one.
        e = mean - ((project(camera, X, pose) - x) * n).sum(1)
        return float(
            (np.where(gain > 0.5, 0.5 * share * cauchy**2 * np.log1p((e / cauchy) ** 2) / variance, 0.0)).sum()
        )

    pose = stepped(POSE, 0.004 * rng.normal(size=6), one.size)
    H, g = one.line_system(np.ascontiguousarray(pose), 1.5)
    tells_apart(g, -gradient_of(lambda p: pull(p, 1.5), one.size, pose), 2e-3)

    # Its curvature is that of Gauss and Newton: J of the residuals by differences.
    def along(d: np.ndarray) -> np.ndarray:
        return (project(camera, X, stepped(pose, d, one.size)) * n).sum(1)

    J = np.stack([(along(1e-5 * e) - along(-1e-5 * e)) / 2e-5 for e in np.eye(6)], 1)
    e = mean - ((project(camera, X, pose) - x) * n).sum(1)
    w = np.where(gain > 0.5, share / variance / (1.0 + (e / 1.5) ** 2), 0.0)
    tells_apart(H, J.T @ (w[:, None] * J), 2e-3)


def harmonics(n: np.ndarray) -> np.ndarray:
    x, y, z = n.T
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 1.5 * z * z - 0.5], 1)


@pytest.mark.parametrize("name", ["perspective", "distorted", "orthographic"])
def test_texture_pulls_as_its_likelihood_falls(name):
    """On a smooth picture the gradient is that of the residuals' sum of squares, with the light at its best."""
    camera, mesh = CAMERAS[name], potato()
    X, N = on_surface(mesh, 400)
    rng = np.random.default_rng(6)
    albedo = rng.uniform(0.3, 0.7, (len(X), 3))
    one = probe(camera, mesh, points(X, N, np.repeat(albedo[None], 7, 0)))
    yy, xx = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    slopes = rng.uniform(-0.0015, 0.0015, (3, 2))
    image = np.stack([0.35 + a * (xx - 80.0) + b * (yy - 60.0) for a, b in slopes], -1)
    one.read(image.astype(np.float32))
    chosen = np.array(one.choose_texture())
    assert len(chosen) > 100
    X, N, albedo = X[chosen], N[chosen], albedo[chosen]
    first = np.zeros((3, 9))
    first[:, 0] = 0.7
    (H, g), light, deviation = one.texture_system(0, np.ascontiguousarray(POSE), first, 0.1)

    def seen(pose: np.ndarray) -> np.ndarray:
        x = project(camera, X, pose)
        return np.stack([0.35 + a * (x[:, 0] - 80.0) + b * (x[:, 1] - 60.0) for a, b in slopes], 1)

    L = harmonics(N @ POSE[:, :3].T)  # The light's change with the rotation is left out.
    residual = np.abs(albedo * (L @ first.T) - seen(POSE))
    sigma = min(max(1.48 * np.sort(residual.ravel())[residual.size // 2], 0.01), 0.15)
    assert deviation == pytest.approx(min(sigma, 0.105), rel=1e-4)
    w = (np.maximum(1.0 - (residual / (4.0 * sigma)) ** 2, 0.0) ** 2).min(1)

    def solved(pose: np.ndarray) -> tuple[float, np.ndarray]:
        cost, lights = 0.0, []
        for c in range(3):
            A = albedo[:, c, None] * L
            C = (w[:, None] * A).T @ A
            prior = 0.003 * np.trace(C) * np.diag([0.01, *[1.0] * 8])
            l = np.linalg.solve(C + prior, A.T @ (w * seen(pose)[:, c]))
            lights.append(l)
            r = A @ l - seen(pose)[:, c]
            cost += 0.5 * float(w @ r**2 + l @ prior @ l) / (3.0 * deviation**2)
        return cost, np.stack(lights)

    assert np.allclose(light, solved(POSE)[1], atol=1e-3)
    tells_apart(g, -gradient_of(lambda p: solved(p)[0], one.size, POSE), 5e-3)
    # On a picture that is linear in x, the cost is quadratic but for the projection's curvature, which J leaves out.
    J = np.stack(
        [
            (seen(stepped(POSE, 1e-5 * e, one.size)) - seen(stepped(POSE, -1e-5 * e, one.size))) / 2e-5
            for e in np.eye(6)
        ],
        -1,
    )
    expected = np.zeros((6, 6))
    for c in range(3):
        A = albedo[:, c, None] * L
        C = (w[:, None] * A).T @ A
        C += 0.003 * np.trace(C) * np.diag([0.01, *[1.0] * 8])
        B = (w[:, None] * A).T @ J[:, c]
        expected += ((w[:, None] * J[:, c]).T @ J[:, c] - B.T @ np.linalg.solve(C, B)) / (3.0 * deviation**2)
    tells_apart(H, expected, 5e-3)


@pytest.mark.parametrize("name", ["perspective", "distorted", "fisheye", "orthographic"])
def test_depth_pulls_as_its_likelihood_falls(name):
    """A depth image of tangent planes: a pixel's depth changes as its ray meets the moved plane elsewhere."""
    camera, mesh = CAMERAS[name], potato()
    X, N = on_surface(mesh, 250, seed=7)
    one = probe(camera, mesh, surface=points(X, N))
    kernel = in_kernel(camera)
    z = np.full(SIZE, np.nan, np.float32)
    rng = np.random.default_rng(8)
    q, n = X @ POSE[:, :3].T + POSE[:, 3], N @ POSE[:, :3].T
    x = project(camera, X, POSE)
    rays = [parts.track_ray(kernel, [math.floor(p[0]) + 0.5, math.floor(p[1]) + 0.5]) for p in x]
    towards = q if name != "orthographic" else np.tile([0.0, 0.0, 1.0], (len(q), 1))
    facing = -(n * towards).sum(1) / np.linalg.norm(towards, axis=1) > 0.3

    def depth_at(k: int, pose: np.ndarray) -> float:
        p, m = pose[:, :3] @ X[k] + pose[:, 3], pose[:, :3] @ N[k]
        o, d = rays[k][:3], rays[k][3:]
        return float((o + (m @ (p - o)) / (m @ d) * d)[2])

    # Only one point a pixel, so that each measurement is of the plane that it was made of.
    owner: dict[tuple[int, int], int] = {}
    for k in np.flatnonzero(facing):
        owner.setdefault((int(x[k, 1]), int(x[k, 0])), k)
    noise = {k: 0.02 * rng.normal() for k in owner.values()}
    # Points that share a pixel with others, or that the body hides, must not count: their pixels are not measured.
    taken = [(int(x[k, 1]), int(x[k, 0])) for k in np.flatnonzero(facing)]
    single = {p: k for p, k in owner.items() if taken.count(p) == 1}
    for (j, i), k in single.items():
        z[j, i] = depth_at(k, POSE) + noise[k]
    _, g = one.depth_system(z, np.ascontiguousarray(POSE))
    used = list(single.values())
    r = np.array([z[int(x[k, 1]), int(x[k, 0])] - depth_at(k, POSE) for k in used])
    sigma = np.clip(1.4826 * np.sort(np.abs(r))[len(r) // 2], 0.002 * one.size, 0.05 * one.size)
    likely = 0.9 * np.exp(-0.5 * (r / sigma) ** 2) * one.size / (sigma * math.sqrt(2.0 * math.pi))
    share = likely / (likely + 0.1)

    def cost(pose: np.ndarray) -> float:
        e = np.array([z[int(x[k, 1]), int(x[k, 0])] - depth_at(k, pose) for k in used])
        return float(0.5 * (share * (e / sigma) ** 2).sum())

    expected = -gradient_of(cost, one.size, POSE)
    # The body is nearly convex, so that it hides few of these points.
    tells_apart(g, expected, 0.02)
