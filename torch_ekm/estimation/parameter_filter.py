"""One Gaussian update, and filters of a hand's parameters on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from .._checks import check_finite, check_shape
from .._recorded import Recorded, bound_problems, covariance_problems
from ..exceptions import ParameterError
from ..typing import AnyArray, Array, Float, Tensor


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


_DRIFT = 1e-3  # q: share of the prior that comes back with each motion
_SURPRISE = 3.0  # times what is usual, from which a motion counts less, and speaks for a change
_RECENT = 0.05  # weight of the last motion in what is usual
_IN_A_ROW = 2  # such motions in succession are a change: a contact that slides once is none


class ParameterFilter(Recorded, nn.Module):
    """``theta ~ N(m, P)``, an extended Kalman filter on ``r = ds - f(s, da; m)``, ``phi = df/dtheta``::

        m <- m_0 + sqrt(1 - q) (m - m_0),  P <- (1 - q) P + q P_0          q = 1e-3
        m, P <- update(m, P, r, phi, R / w)            w = min(1, 3 max(1, u) / z)
        z = r' (phi P phi' + R)^-1 r / n_r,  u: mean of the last z

    One motion costs the same time and memory however many came before. What is not identified returns to
    the start m_0 and its covariance P_0. A motion that the present uncertainty does not explain, as where a
    contact slides, counts less; two of them in succession are taken for a change of the plant, and P is P_0
    again.

    Args:
        names: of the parameters.
        start: m before the first motion, in the parameters' units.
        prior: P_0 ``(n, n)``, or standard deviations ``(n,)``.
        lower, upper: bounds; None: there are none.

    Raises:
        ParameterError: sizes do not go together, P_0 is no covariance, or ``start`` is out of bounds.

    Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), ch. 8; the weight is that of a t law,
    see Agamennoni et al., IEEE Trans. Signal Processing 60 (2012).
    """

    def __init__(
        self,
        names: Sequence[str],
        start: Sequence[float] | Float[Tensor, " n"],
        prior: Sequence[float] | Float[Tensor, " n"] | Float[Tensor, "n n"],
        lower: Sequence[float] | Float[Tensor, " n"] | None = None,
        upper: Sequence[float] | Float[Tensor, " n"] | None = None,
    ) -> None:
        super().__init__()
        self.names, n = tuple(names), len(names)

        def vector(name: str, values: Any, default: float = 0.0) -> Tensor:
            full = torch.as_tensor([default] * n if values is None else values, dtype=torch.float64)
            if full.shape != (n,) or bool(full.isnan().any()):
                raise ParameterError(name, values, f"{n} numbers, one for each of the names")
            return full

        covariance = torch.as_tensor(prior, dtype=torch.float64)
        if covariance.dim() == 1:
            covariance = torch.diag(vector("prior", prior).square())
        good = covariance.shape == (n, n) and bool(covariance.isfinite().all())
        good = good and torch.allclose(covariance, covariance.mT)
        if not good or float(torch.linalg.eigvalsh(covariance)[0]) <= 0:
            raise ParameterError("prior", prior, f"{n} standard deviations, or a covariance {n} x {n}")
        self.prior = nn.Buffer(covariance, persistent=False)
        """P_0."""
        self.lower = nn.Buffer(vector("lower", lower, -torch.inf), persistent=False)
        self.upper = nn.Buffer(vector("upper", upper, torch.inf), persistent=False)
        self.start = nn.Buffer(vector("start", start), persistent=False)
        """m_0."""
        self.mean = nn.Buffer(self.start.clone())
        """m."""
        if bool(((self.mean < self.lower) | (self.mean > self.upper)).any()):
            raise ParameterError("start", start, "within the bounds")
        self.covariance = nn.Buffer(covariance.clone())
        """P."""
        self.count = nn.Buffer(torch.zeros((), dtype=torch.int64))
        """Motions learned."""
        self.usual = nn.Buffer(torch.ones((), dtype=torch.float64))
        """u."""
        self.surprises = nn.Buffer(torch.zeros((), dtype=torch.int64))
        """Surprising motions in succession."""
        self.changed_at = nn.Buffer(torch.full((), -1, dtype=torch.int64))
        """Count at the last change; -1: there was none."""
        self.before = nn.Buffer(self.mean.clone())
        """m before the last change."""
        self.before_covariance = nn.Buffer(covariance.clone())

    def __len__(self) -> int:
        return len(self.names)

    @property
    def stddev(self) -> Float[Tensor, " n"]:
        """Standard deviations of the parameters."""
        return self.covariance.diagonal().sqrt()

    @torch.no_grad()
    def update(
        self,
        residual: Float[Tensor, " n_r"],
        derivative: Float[Tensor, "n_r n"],
        noise: Float[Tensor, " n_r"],
    ) -> float:
        """Learn from one motion.

        Args:
            residual: r, measured less predicted at m.
            derivative: phi at m.
            noise: diagonal of R, variances of what theta does not explain.

        Returns:
            z, of the order of 1 where the model and its uncertainty explain the motion.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
            ParameterError: a variance is not positive; nothing is changed.
        """
        n_r, n = len(residual), len(self)
        check_shape("derivative", derivative, (n_r, n))
        check_shape("noise", noise, (n_r,))
        for name, value in (("residual", residual), ("derivative", derivative), ("noise", noise)):
            check_finite(name, value)
        if not bool((noise > 0).all()):
            raise ParameterError("noise", noise.tolist(), "positive variances")
        figures = residual, derivative, noise, self.covariance, self.prior, self.mean, self.start
        *seen, P, P_0, m, m_0, lower, upper = (
            value.detach().double().cpu().numpy() for value in (*figures, self.lower, self.upper)
        )
        P = (1 - _DRIFT) * P + _DRIFT * P_0
        z = surprise(P, *seen)
        most = _SURPRISE * max(1.0, float(self.usual))
        self.usual += _RECENT * (min(z, most) - self.usual)
        self.surprises.copy_(self.surprises + 1 if z > most else torch.zeros_like(self.surprises))
        if int(self.surprises) >= _IN_A_ROW:
            self.before.copy_(self.mean)
            self.before_covariance.copy_(self.covariance)
            self.changed_at.copy_(self.count)
            self.surprises.zero_()
            P = P_0
        weight = min(1.0, most / z) if z > 0 else 1.0
        r, phi, R = seen
        faded = m_0 + (1 - _DRIFT) ** 0.5 * (m - m_0)
        mean, P = update(faded, P, r, phi, R / weight, at=m, bounds=(lower, upper))
        self.mean.copy_(torch.from_numpy(mean))
        self.covariance.copy_(torch.from_numpy(P))
        self.count += 1
        return z

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        count, wrong = int(state["count"]), []
        for name in ("covariance", "before_covariance"):
            wrong += covariance_problems(name, state[name], self.prior.diagonal())
        for name in ("mean", "before"):
            if bool(((state[name] < self.lower) | (state[name] > self.upper)).any()):
                wrong.append(f"{name} is out of bounds")
        if not count and not torch.equal(state["mean"], self.start.to(state["mean"])):
            wrong.append("mean is not the start, and no motion was learned")
        most = (1 + _RECENT * (_SURPRISE - 1)) ** min(count, 5000)  # of so many surprises in succession
        surprises = 0, _IN_A_ROW - 1
        return wrong + bound_problems(state, usual=(0, most), surprises=surprises, changed_at=(-1, count))

    def extra_repr(self) -> str:
        return f"parameters={len(self)}, motions={int(self.count)}"
