"""One Gaussian update, and what it estimates: parameters of a model, answers of the pads' forces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from .._checks import check_finite, check_kind, check_shape
from .._noise import NOISE
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
        count, mean = int(state["count"]), state["mean"]
        wrong = covariance_problems("covariance", state["covariance"], self.prior.diagonal())
        if bool(((mean < self.lower) | (mean > self.upper)).any()):
            wrong.append("mean is out of bounds")
        if not count and not torch.equal(mean, self.start.to(mean)):
            wrong.append("mean is not the start, and no motion was learned")
        most = (1 + _RECENT * (_SURPRISE - 1)) ** min(count, 5000)  # of so many surprises in succession
        return wrong + bound_problems(state, usual=(0, most), surprises=(0, _IN_A_ROW - 1))

    def extra_repr(self) -> str:
        return f"parameters={len(self)}, motions={int(self.count)}"


_PRIOR_STD = 20.0  # [N/rad] of an entry of B
_WAY_STD = 10.0  # [N/rad] of an entry of l
_LARGEST_STD = 20.0  # [N] of a change of force that c and B do not explain
_LEAST_STD = 0.5 * NOISE.force  # [N] of a pad that does as c and B say
_MOST_EVIDENCE = 1e12  # [N^2]: no pad bears what would make more of it
_USUAL = 1 / 0.3**2 - 1  # information on theta that hands have in common, on top of the prior's
_GRASPS, _MOST_READ = 8, math.log(10.0)  # that count in the mean of the pads' scale, and its bound
_FORGETTING = 0.97  # of what earlier motions say in the direction of a new one
_NEWEST = 0.1  # weight of the last motion in the variance of r


class ForceSensitivity(Recorded, nn.Module):
    """``f_n+ - f_n = (c S + B) w + l |phi| + noise``, S ``= df_n/da``: by recursive least squares::

        u = [S w; 10 |phi|; 20 w],  theta = [c - 1; l / 10; B / 20]        prior N(0, I)
        r = (f_n+ - f_n) - S w - theta u                 of each pad that measures
        D <- D - (1 - .97) D u u' D / (u' D u)           motions, forgotten in the direction of a new one
        theta <- update(theta, (D / s^2 + I)^-1, r, u', s^2),  D <- D + u u'
        s^2 <- .9 s^2 + .1 max(r^2 - u' P u, .15^2)      what is left: a pad that rubs teaches less

    c of each pad scales what the model says: a hand that gives more than it is described to presses less. l
    is what a finger gains or loses as the object turns by phi either way, by friction and creep of cables and
    joints; B ``(n_pads, n_a)`` says the rest. All belong to the hand: they are kept from grasp to grasp.

    Args:
        n_pads, n_a: contact pads and actuators of the hand.

    Source: least squares with directional forgetting, Kulhavy and Karny, IFAC World Congress (1984).
    """

    def __init__(self, n_pads: int, n_a: int) -> None:
        super().__init__()
        self.theta = nn.Buffer(torch.zeros(n_pads, 2 + n_a, dtype=torch.float64))
        self.evidence = nn.Buffer(torch.zeros(n_pads, 2 + n_a, 2 + n_a, dtype=torch.float64))
        """D, of the motions that each pad measured."""
        self.variance = nn.Buffer(torch.full((n_pads,), NOISE.force**2, dtype=torch.float64))
        """s^2 of each pad [N^2]."""
        self.reads = nn.Buffer(torch.zeros(2, dtype=torch.float64))
        """Mean of ln of how many times the pads read what joints and springs give, and of how many grasps."""

    @property
    def usual(self) -> float | None:
        """How many times all pads together read what joints and springs give; None before the first grasp."""
        return math.exp(float(self.reads[0])) if self.reads[1] else None

    def grasped(self, times: float) -> None:
        """All pads together read ``times`` what joints and springs give, in one more grasp of the hand: its
        springs may be others than described, and so may the scale of the pads."""
        before = min(float(self.reads[1]), _GRASPS - 1)
        mean = float(self.reads[0]) + (math.log(times) - float(self.reads[0])) / (before + 1)
        self.reads.copy_(torch.tensor([min(max(mean, -_MOST_READ), _MOST_READ), before + 1]))

    @property
    def scale(self) -> Float[Tensor, " n_pads"]:
        """c."""
        return 1 + self.theta[:, 0]

    @property
    def scale_std(self) -> Float[Tensor, " n_pads"]:
        """Standard error of c."""
        P = _covariance(self.evidence.numpy(), self.variance.numpy())
        return torch.from_numpy(P[:, 0, 0]).sqrt()

    @property
    def correction(self) -> Float[Tensor, "n_pads n_a"]:
        """B [N/rad]."""
        return _PRIOR_STD * self.theta[:, 2:]

    @property
    def by_way(self) -> Float[Tensor, " n_pads"]:
        """l, per turn of the object [N/rad]."""
        return _WAY_STD * self.theta[:, 1]

    def corrected(self, described: Float[Tensor, "n_c n_a"], pads: Sequence[int]) -> Float[Tensor, "n_c n_a"]:
        """``c S + B`` [N/rad].

        Args:
            described: S of the pads in contact [N/rad].
            pads: which of the hand's they are.
        """
        at = list(pads)
        return self.scale[at, None] * described + self.correction[at]

    def spread(
        self, moved: Float[Tensor, " n_a"], said: Float[Tensor, " n_pads"], way: float
    ) -> Float[Tensor, " n_pads"]:
        """``sqrt(u' P u + s^2)``: standard deviation of what is predicted for the change of each force [N].

        P with theta ~ N(0, 0.3^2) before the first motion, as hands were found to be: the wider prior of the
        estimate lets it follow a hand that is none of these.

        Args:
            moved: w [rad].
            said: S w, the change by the model alone [N].
            way: ``|phi|``, turn of the object [rad].
        """
        u = _regressors(said.numpy(), way, moved.numpy())
        variance = self.variance.numpy()
        known = _covariance(
            self.evidence.numpy() + _USUAL * variance[:, None, None] * np.eye(u.shape[-1]), variance
        )
        return torch.from_numpy(np.sqrt(variance + ((known @ u[..., None])[..., 0] * u).sum(-1)))

    @torch.no_grad()
    def update(
        self,
        moved: Float[Tensor, " n_a"],
        change: Float[Tensor, " n_pads"],
        said: Float[Tensor, " n_pads"],
        way: float,
    ) -> Float[Tensor, " n_pads"]:
        """Learn from one motion.

        Args:
            moved: w, of the encoders [rad].
            change: ``f_n+ - f_n`` of each pad [N]; NaN: it does not measure, or does not touch.
            said: S w, the change by the model alone [N].
            way: ``|phi|``, turn of the object [rad].

        Returns:
            r [N], NaN where nothing was measured.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
        """
        n_pads, n_a = len(self.theta), self.theta.shape[-1] - 2
        for name, value, shape in (
            ("moved", moved, (n_a,)), ("change", change, (n_pads,)), ("said", said, (n_pads,))
        ):  # fmt: skip
            check_shape(name, value, shape)
        check_finite("moved", moved)
        check_finite("said", said)
        check_finite("way", torch.tensor(check_kind("way", way, float)))
        w, df, answer = (x.detach().double().numpy() for x in (moved, change, said))
        buffers = self.theta, self.evidence, self.variance
        theta, D, variance = (buffer.numpy() for buffer in buffers)  # their own memory
        u = _regressors(answer, way, w)
        r = df - answer - (u * theta).sum(-1)
        known = ~np.isnan(r)
        if not known.any() or not w.any():
            return torch.from_numpy(r)
        doubt = ((_covariance(D, variance) @ u[..., None])[..., 0] * u).sum(-1)  # u' P u
        spread = np.sqrt(variance + doubt)
        Du = (D @ u[..., None])[..., 0]
        seen = np.maximum((Du * u).sum(-1), np.finfo(float).tiny)[:, None, None]
        D[known] -= ((1 - _FORGETTING) * Du[:, :, None] * Du[:, None, :] / seen)[known]
        most = NOISE.outlier * spread  # a contact that slips says nothing of the rest
        bounded = np.clip(r, -most, most)
        one = bounded[:, None], u[:, None, :], variance[:, None]
        after, _ = update(theta, _covariance(D, variance), *one, bounds=(-NOISE.furthest, NOISE.furthest))
        theta[known] = after[known]
        D[known] += (u[:, :, None] * u[:, None, :])[known]
        unexplained = np.clip(bounded**2 - doubt, _LEAST_STD**2, _LARGEST_STD**2)
        variance[known] += _NEWEST * (unexplained - variance)[known]
        return torch.from_numpy(r)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        wrong = bound_problems(
            state,
            theta=(-NOISE.furthest, NOISE.furthest),
            variance=(0.9 * _LEAST_STD**2, _LARGEST_STD**2),  # files of a smaller noise hold
            evidence=(-_MOST_EVIDENCE, _MOST_EVIDENCE),
            reads=(-_MOST_READ, _GRASPS),
        )
        if wrong:
            return wrong
        D = state["evidence"]
        if bool((state["theta"].any(-1) & ~D.flatten(1).any(-1)).any()):
            return ["theta is known of a pad without evidence"]
        unit = (1e-9 + 1e-9 * D.abs().amax((-2, -1), keepdim=True)) * torch.eye(D.shape[-1], dtype=D.dtype)
        return covariance_problems("evidence", D + unit)  # it begins at 0, and rounding makes some below

    def extra_repr(self) -> str:
        return f"pads={len(self.theta)}, largest={float(self.correction.abs().max()):.3g} N/rad"


def _regressors(said: Array, way: float, w: Array) -> Array:
    """u of each pad."""
    alike = np.concatenate([[_WAY_STD * way], _PRIOR_STD * w])
    return np.concatenate([said[:, None], np.tile(alike, (len(said), 1))], axis=-1)


def _covariance(D: Array, variance: Array) -> Any:
    """P of each pad."""
    return np.linalg.inv(D / variance[:, None, None] + np.eye(D.shape[-1]))
