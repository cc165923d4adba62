"""Directions in sets, in which what the derivatives of a glossy lobe have of both signs cancels (csrc/shading/lit/antithetic.h,
which names the sources)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from edgegrad.light.bsdf import dot

ASIDE, PART = 0.2, 0.1  # the cosine, and the share of it that the normals differ by
LEAST_TANGENT2 = 1e-24  # below it a normal has no azimuth in doubles


def seen_aside(v: Tensor, n: Tensor, g: Tensor) -> Tensor:
    """(N,) bool, of unit directions (N, 3) to the viewer, shading normals and normals of faces: where faces are seen from aside
    and both normals differ by a part of that angle (sets_of() in csrc/shading/lit/derivative_points.h says why)."""
    nv, apart = dot(n, v).clamp(min=0)[:, 0], torch.linalg.cross(g, n)
    return (nv < ASIDE) & (dot(apart, apart)[:, 0] > (PART * nv) ** 2)


def antithetic_set(v: Tensor, n: Tensor, alpha: Tensor, l: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 4, 3) directions and (N, 4) their solid angles over that of the normal of the first, of unit directions (N, 3) to the
    viewer, of the normal and to the light, and α (N, 1).

    By the half vector h = unit(v + l), at the angle θ from the normal: h itself, h turned by π about n, h at the angle θ' with
    tan θ tan θ' = α², and that one turned.
    """
    h = normalize(v + l, dim=-1)
    sine = torch.linalg.cross(n, h)
    cosine = dot(n, h)
    t = dot(sine, sine) / (cosine * cosine)
    known = (cosine > 0) & (t > LEAST_TANGENT2)  # else the lobe of a normal that is turned away, or its middle
    along = cosine * n
    across = h - along
    ratio = torch.where(known, alpha * alpha / t, 1.0)
    other = 1 / (1 + ratio * ratio * t).sqrt()
    c = torch.where(known, other / cosine, 1.0)
    one, other_measure = torch.ones_like(c), c**3 * ratio**2  # dω = ½ cos³ θ dt dφ
    normals = [h, along - across, other * n + ratio * c * across, other * n - ratio * c * across]
    directions, measures = [l], []
    for k, (m, share) in enumerate(zip(normals, [one, one, other_measure, other_measure], strict=True)):
        # dω_l = 4 (v·h) dω_h. Where v·h < 0 no direction has this normal.
        vh = dot(v, m)
        measures.append(torch.where(known, 4 * share * vh.clamp(min=0), 1.0 if k == 0 else 0.0))
        if k:
            directions.append(torch.where(known, normalize(2 * vh * m - v, dim=-1), l))
    return torch.stack(directions, 1), torch.cat(measures, 1)
