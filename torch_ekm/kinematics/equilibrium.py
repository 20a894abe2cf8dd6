"""Where a hand that touches nothing comes to rest, and how that changes with its motors."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from .._checks import check_last
from ..description import HandDescription
from ..exceptions import EquilibriumError
from ..typing import Array, Float, Tensor

_NEWTON = 60  # steps before the way of the motors is divided
_EXACT = 1e-12  # [rad] of the last step
_ROUNDING = 1e-9  # [rad] of one that does not become smaller
_LONGEST = 0.3  # [rad] of a step where arms change
_DIVIDED = 7  # times that a way is halved
_SOFT = 1e-6  # [rad/(N m)] of a rigid drive that works against a stop; without one it has none
_UNSOLVED = 1e-7  # of the right side: what may be left of it


class Rest(NamedTuple):
    """A posture without contacts."""

    q: Array
    """``(n_q,)`` [rad]."""
    pull: Array
    """Force of each actuator along +a, ``(n_a,)`` [N m]; 0 of slack tendons."""
    projector: Array
    """P = dq/da, ``(n_q, n_a)``."""


class FreeHand:
    r"""``min_q V_s(q) + 1/2 sum_i k_i (a_i - l_i(q))^2`` subject to loops, couplings and joint stops.

    V_s is the energy of the springs over joints and tendons. Tendons only pull; a rigid drive has
    ``l_i(q) = a_i`` in place of its energy. Newton's method on the conditions of Karush, Kuhn and Tucker::

        K (q - q0) + sum_r f_r dv_r/dq = 0,   v_r(q) - c_r f_r = low_r where f_r < 0, high_r where f_r > 0

    with a row r for each drive, tendon spring, coupling, loop and stop: its value v, its compliance c, and
    the interval in which it has no force. The primal-dual active set decides which rows have one. The
    projector dq/da follows from the implicit function theorem.
    """

    def __init__(self, hand: HandDescription) -> None:
        self._hand, n_q, n_a = hand, hand.n_q, hand.n_a
        C, springs, loops = hand.coupling.reshape(-1, n_q), hand.tendon_springs, hand.loops
        k = np.array([actuator.stiffness for actuator in hand.actuators])
        self._pulls = np.array([actuator.tendon for actuator in hand.actuators], dtype=bool)
        compliance, low, high = [1 / k], [np.zeros(n_a)], [np.zeros(n_a)]
        if springs is not None:
            compliance.append(1 / springs.stiffness)
            low.append(springs.low)
            high.append(springs.high)
        if loops is not None:
            low.append(loops.value)
            high.append(loops.value)
        low += [C @ hand.spring_rest, hand.joint_lower]
        high += [C @ hand.spring_rest, hand.joint_upper]
        self._low, self._high = np.concatenate(low), np.concatenate(high)
        soft = np.concatenate(compliance)
        self._compliance = np.concatenate([soft, np.zeros(len(self._low) - len(soft))])
        self._rigid = np.flatnonzero(np.isinf(k))
        self._fixed = np.vstack([C, np.eye(n_q)])
        self._straight = hand.lengths.constant and springs is None and loops is None
        q0 = np.clip(hand.spring_rest, hand.joint_lower, hand.joint_upper)
        self._slack = hand.unloaded(q0)
        self._start = q0, np.zeros(len(self._low))

    def __call__(self, a: Array) -> Rest:
        """At rest with the motors at ``a (n_a,)``.

        Raises:
            EquilibriumError: none was found.
        """
        q, f = self._start
        found, done, share = self._solve(a, q, f), 0.0, 0.5
        while found is None:  # by and by, from where all tendons are slack
            part = min(1.0, done + share)
            stage = self._solve(self._slack + part * (a - self._slack), q, f)
            if stage is not None:
                (q, f, *_), done, share = stage, part, 2 * share
                found = stage if part == 1 else None
            elif (share := share / 2) < 0.5**_DIVIDED:
                status = f"no posture was found with the motors at {a.round(3).tolist()}"
                raise EquilibriumError(f"free motion of '{self._hand.name}'", status)
        n_q = len(q)
        q, f, K, active = found
        right = np.zeros((len(K), len(a)))
        motors = np.flatnonzero(active < len(a))
        right[n_q + motors, active[motors]] = 1.0
        return Rest(q, -f[: len(a)], _solved(K, right)[:n_q])

    def _rows(self, q: Array) -> tuple[Array, Array]:
        """Values of the rows, and their derivatives."""
        hand = self._hand
        value = [hand.unloaded(q)]
        slope = [hand.lengths.jacobian(q, hand.actuation_jacobian)]
        for part in (hand.tendon_springs, hand.loops):
            if part is not None:
                value.append(part.lengths.length(q))
                slope.append(part.lengths.jacobian(q))
        return np.concatenate([*value, self._fixed @ q]), np.vstack([*slope, self._fixed])

    def _bends(self, q: Array, f: Array) -> Array:
        """``sum_r f_r d2v_r/dq2``."""
        hand, first = self._hand, self._hand.n_a
        found = hand.lengths.curvature(q, f[:first], hand.actuation_jacobian)
        for part in (hand.tendon_springs, hand.loops):
            if part is not None:
                n = len(part.names)
                found = found + part.lengths.curvature(q, f[first : first + n])
                first += n
        return found

    def _solve(self, a: Array, q: Array, f: Array) -> tuple[Array, Array, Array, NDArray[np.intp]] | None:
        """Posture, forces of the rows, last matrix, and which rows are in it since they have a force; from a
        posture and forces nearby. None: it does not converge."""
        hand, n_q, n_a = self._hand, len(q), len(a)
        low, high, compliance = self._low.copy(), self._high.copy(), self._compliance.copy()
        low[:n_a] = a
        high[:n_a] = np.where(self._pulls, np.inf, a)
        springs, n_stop = np.diag(hand.spring_stiffness), len(low) - n_q
        seen, last, before = set[bytes](), b"", np.inf
        for _ in range(_NEWTON):
            value, J = self._rows(q)
            unit = (J * J).sum(axis=1)  # [rad/(N m)] in the row's own units
            at = value - compliance * f + unit * f
            end = np.where(at < low, low, np.where(at > high, high, np.nan))
            end = np.where(low == high, low, end)
            active = np.flatnonzero(~np.isnan(end))
            pressed = (active >= n_stop).any()
            compliance[self._rigid] = _SOFT * unit[self._rigid] if pressed else 0.0
            state = end[active].tobytes() + active.tobytes()
            if self._straight and state != last and state in seen:
                return None  # it goes round in a circle
            seen.add(state)
            last = state
            K = np.zeros((n_q + len(active),) * 2)
            K[:n_q, :n_q] = springs + (0.0 if self._straight else self._bends(q, f))
            K[:n_q, n_q:], K[n_q:, :n_q] = J[active].T, J[active]
            K[np.arange(n_q, len(K)), np.arange(n_q, len(K))] = -compliance[active]
            right = np.concatenate([hand.spring_stiffness * (hand.spring_rest - q), (end - value)[active]])
            x = _solved(K, right)
            step = x[:n_q]
            size = float(np.abs(step).max())
            if not np.isfinite(size):
                return None
            part = 1.0 if self._straight else min(1.0, _LONGEST / max(size, _LONGEST))
            q = q + part * step
            after = np.zeros_like(f)
            after[active] = x[n_q:]
            f = f + part * (after - f)
            if size < _EXACT or before < size < _ROUNDING:
                off = np.abs(K @ x - right).max()
                return (q, f, K, active) if off < _UNSOLVED * max(1.0, np.abs(right).max()) else None
            before = size
        return None


def _solved(K: Array, right: Array) -> Any:
    """``K^-1 right``; the least answer where forces do not follow from postures."""
    try:
        found = np.linalg.solve(K, right)
        if np.abs(K @ found - right).max() <= _UNSOLVED * max(1.0, np.abs(right).max()):
            return found
    except np.linalg.LinAlgError:
        pass
    return np.linalg.lstsq(K, right, rcond=1e-12)[0]


class ActuationMap(nn.Module):
    r"""``a = a_0 + l(q)``, and where a hand that touches nothing rests with its motors at a:

    ``q(a) = argmin V_s(q) + 1/2 sum_i k_i (a_i - a_0i - l_i(q))^2``,

    within the joint stops, with the rigid couplings and loops that the description has. V_s is the energy of
    the springs; tendons only pull, rigid drives have ``a = a_0 + l(q)``. With constant moment arms and equal
    springs a distal tendon splits evenly, as iKin assumes for the iCub. Angles [rad].

    Args:
        hand: the hand.
        dtype: of the answers; change it later with ``.to()``.
    """

    J_a: Float[Tensor, "n_a n_q"]
    """Moment arms of the description, typical ones where they change with the posture."""

    def __init__(self, hand: HandDescription, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.hand = hand
        self.register_buffer("J_a", torch.from_numpy(hand.actuation_jacobian).to(dtype), persistent=False)
        self._free = FreeHand(hand)

    def actuators(self, q: Float[Tensor, "*batch n_q"]) -> Float[Tensor, "*batch n_a"]:
        """``a = a_0 + l(q)`` [rad]: of tendons that are not stretched.

        Raises:
            ShapeError: the last dimension is not ``n_q``; the message lists the joints.
        """
        self._check("q", q, self.hand.joint_names)
        hand, at = self.hand, q.detach().double().cpu().numpy()
        arms = hand.lengths.jacobian(at, hand.actuation_jacobian)
        return _along(q, at, hand.unloaded(at), arms)

    def joints(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_q"]:
        """Posture of the hand that touches nothing [rad].

        Raises:
            ShapeError: the last dimension is not ``n_a``; the message lists the actuators.
            EquilibriumError: none was found.
        """
        at, q, _, P = self._rests(a)
        return _along(a, at, q, P)

    def free_motion(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_q n_a"]:
        """P = dq/da of the hand that touches nothing; 0 for slack tendons and joints at their stops.

        Raises:
            ShapeError, EquilibriumError: as :meth:`joints`.
        """
        return torch.from_numpy(self._rests(a)[3]).to(self.J_a)

    def pull(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_a"]:
        """Force of each actuator along +a in the hand that touches nothing [N m]; 0 of slack tendons.

        Raises:
            ShapeError, EquilibriumError: as :meth:`joints`.
        """
        return torch.from_numpy(self._rests(a)[2]).to(self.J_a)

    def _rests(self, a: Tensor) -> tuple[Array, Array, Array, Array]:
        """a, and the parts of :class:`Rest` of each of the batch."""
        self._check("a", a, self.hand.actuator_names)
        at = a.detach().double().cpu().numpy()
        rests = zip(*map(self._free, at.reshape(-1, at.shape[-1])), strict=True)
        q, pull, P = (np.array(part).reshape(*at.shape[:-1], *part[0].shape) for part in rests)
        return at, q, pull, P

    def _check(self, name: str, value: Tensor, names: tuple[str, ...]) -> None:
        check_last(name, value, len(names), f"in order: {', '.join(names)}")

    def extra_repr(self) -> str:
        return f"'{self.hand.name}', actuators={self.hand.n_a}, joints={self.hand.n_q}"


def _along(x: Tensor, at: np.ndarray, value: np.ndarray, slope: np.ndarray) -> Tensor:
    """The value at x, with its derivative."""
    found = torch.from_numpy(value).to(x)
    if x.requires_grad:
        away = x - torch.from_numpy(at).to(x)
        found = found + (torch.from_numpy(slope).to(x) @ away[..., None])[..., 0]
    return found
