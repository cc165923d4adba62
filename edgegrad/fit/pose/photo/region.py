"""The region term: the object is where the colours are that it has, beside those that lie around it.

Of a pixel x whose colour is p_f as frequent inside the silhouette, near x, and p_b outside of it, the posterior that it shows the
object is P = p_f / (p_f + p_b). A render covers the share α of it, so the likelihood is f = α P + (1 − α)(1 − P), and the loss
−Σ log f (Prisacariu and Reid, PWP3D, 2012). Colours are counted near each pixel, for those of the whole picture seldom tell an
object from what surrounds it (Tjaden et al., A Region-Based Gauss-Newton Approach, 2017).

The gradient is −Σ (2P − 1)/f ∇α, with P held fixed, and the curvature is Σ of the squares of the same, Fisher's information.
"""

from __future__ import annotations

from torch import Tensor

from ..gauss_newton import Normal
from .picture import Windows, smoothed

LEAST = 1e-4  # frequency of any colour
OUTLIERS = 1e-3  # likelihood of pixels that tell nothing


def posterior(windows: Windows, alpha: Tensor, near: Tensor) -> Tensor:
    """(h, w), of the colours as the silhouette alpha (h, w) divides them; `near` (h, w) counts what surrounds the object."""
    inside, outside = windows.frequencies(alpha * near), windows.frequencies((1.0 - alpha) * near)
    return (inside + LEAST) / (inside + outside + 2.0 * LEAST)


def region_term(posterior: Tensor, alpha: Tensor, tangents: Tensor, near: Tensor, sigma: float) -> tuple[Normal, float]:
    """The equations of alpha (h, w) with its derivatives (n, h, w), both blurred by `sigma` pixels, which widens the reach of a
    step, and the mean loss of a pixel; `near` (h, w) counts what surrounds the object."""
    soft = smoothed(alpha[None], sigma)[0]
    likelihood = soft * posterior + (1.0 - soft) * (1.0 - posterior) + OUTLIERS
    slope = -(2.0 * posterior - 1.0) / likelihood * near
    J = smoothed(tangents, sigma).flatten(1).double()
    weighted = J * slope.flatten()
    loss = -float((near * likelihood.log()).sum()) / max(float(near.sum()), 1e-30)
    return Normal(weighted @ weighted.T, weighted.sum(1)), loss
