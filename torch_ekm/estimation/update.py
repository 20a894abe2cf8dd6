"""The update of all Gaussian estimates."""

from __future__ import annotations

import numpy as np

from ..typing import AnyArray, Array, Float


def update(
    mean: Float[AnyArray, "*batch n"],
    P: Float[AnyArray, "*batch n n"],
    residual: Float[AnyArray, "*batch m"],
    H: Float[AnyArray, "*batch m n"],
    R: Float[AnyArray, "*batch m"] | Float[AnyArray, "*batch m m"],
    *,
    at: Float[AnyArray, "*batch n"] | None = None,
    bounds: tuple[AnyArray, AnyArray] | None = None,
) -> tuple[Array, Array]:
    """``x ~ N(m, P)`` given ``y = h(x) + N(0, R)``, with h linearized at ``x_0``::

        K = P H' (H P H' + R)^-1
        m <- m + K (y - h(x_0) + H (x_0 - m))          within the bounds
        P <- (I - K H) P (I - K H)' + K R K'           a covariance for any K (Joseph)

    Repeated with ``at`` the mean that it gives, it is the iterated Kalman filter, which is Gauss-Newton on
    the likelihood. An observation that counts with the weight w has the noise R / w.

    Args:
        mean, P: m and P before it; tensors will do, too.
        residual: ``y - h(x_0)``.
        H: dh/dx at x_0.
        R: covariance of the noise, or its diagonal.
        at: x_0; None: m.
        bounds: of m, below and above.

    Returns:
        m and P after it.

    Source: Bell and Cathey, IEEE Trans. Automatic Control 38(2), 1993.
    """
    mean, P, residual, H, R = map(np.asarray, (mean, P, residual, H, R))
    noise = R if R.ndim == H.ndim else R[..., None] * np.eye(R.shape[-1])
    HP = H @ P
    K = np.linalg.solve(HP @ H.mT + noise, HP).mT
    r = residual if at is None else residual + (H @ (np.asarray(at) - mean)[..., None])[..., 0]
    mean = mean + (K @ r[..., None])[..., 0]
    left = np.eye(P.shape[-1]) - K @ H
    P = left @ P @ left.mT + K @ noise @ K.mT
    return mean if bounds is None else np.clip(mean, *bounds), 0.5 * (P + P.mT)


def surprise(P: Array, residual: Array, H: Array, R: Array) -> float:
    """``r' (H P H' + diag(R))^-1 r / m``: of the order of 1 where P and R explain a residual."""
    return float(residual @ np.linalg.solve(H @ P @ H.T + np.diag(R), residual)) / len(residual)
