"""Lengths of tendons over the joints' angles, their moment arms, and how these change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from ..typing import Array

_STEP = 1e-5  # [rad] of differences between moment arms
_LEAST = 0.1  # of the largest arm of a joint's range: a mean arm below it is no measure of the others
_SAMPLES = 33  # angles of a joint's range at which arms are compared


class ArmFunction(NamedTuple):
    """A moment arm over its joint's angle, in pieces: ``arm(q) = sum_k c_k (q - origin)^k``."""

    knots: Array
    """Angles at which one piece ends and the next begins, ``(m,)`` [rad]."""
    origin: Array
    """``(m + 1,)`` [rad]."""
    coefficients: Array
    """``(m + 1, degree + 1)``, lowest power first."""

    @classmethod
    def polynomial(cls, coefficients: Sequence[float]) -> ArmFunction:
        """``arm(q) = sum_k c_k q^k``."""
        return cls(np.zeros(0), np.zeros(1), np.array([coefficients], dtype=np.float64))

    @classmethod
    def table(cls, angle: Sequence[float], arm: Sequence[float]) -> ArmFunction:
        """The natural cubic spline through a table, twice differentiable, straight beyond its ends.

        Args:
            angle: two or more, increasing [rad].
            arm: there.
        """
        x, y = np.array(angle, dtype=np.float64), np.array(arm, dtype=np.float64)
        n, step, slope = len(x), np.diff(x), np.diff(y) / np.diff(x)
        M, right = np.eye(n), np.zeros(n)  # of the second derivatives at the knots
        for k in range(1, n - 1):
            M[k, k - 1 : k + 2] = step[k - 1] / 6, (step[k - 1] + step[k]) / 3, step[k] / 6
            right[k] = slope[k] - slope[k - 1]
        bend = np.linalg.solve(M, right)
        inner = np.stack(
            [y[:-1], slope - step * (2 * bend[:-1] + bend[1:]) / 6, bend[:-1] / 2, np.diff(bend) / (6 * step)]
        ).T
        first = [y[0], inner[0, 1], 0.0, 0.0]
        last = [y[-1], slope[-1] + step[-1] * (bend[-2] + 2 * bend[-1]) / 6, 0.0, 0.0]
        return cls(x, np.concatenate([x[:1], x]), np.vstack([first, inner, last]))

    def typical(self, lower: float, upper: float) -> float:
        """The mean arm over a joint's range, which makes its stroke right; where it is next to nothing, the
        largest."""
        low, high = max(lower, -np.pi), min(upper, np.pi)
        arms = _evaluate(_stacked([self]), np.linspace(low, high, _SAMPLES)[:, None])[1][:, 0]
        mean, largest = float(arms.mean()), float(arms[np.abs(arms).argmax()])
        return mean if abs(mean) > _LEAST * abs(largest) else largest


class Routed(Protocol):
    """Lengths that depend on several joints at a time: tendons on their ways, points that meet."""

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Lengths ``(n,)`` and their arms ``(n, n_q)`` at one posture ``(n_q,)``."""
        ...


@dataclass(frozen=True)
class Lengths:
    """``l(q)`` of n tendons, ``J = dl/dq = arms * ratio(q)`` and ``sum_i w_i d2l_i/dq2``.

    The arms that are given count: factors of the ``typical`` ones, of which the functions keep their shapes.
    """

    typical: Array
    """Typical arms ``(n, n_q)``; all that there is of constant ones."""
    functions: tuple[tuple[int, int, ArmFunction], ...] = ()
    """Row, joint and arm of those that change with their joint's angle alone."""
    routed: tuple[tuple[tuple[int, ...], Routed], ...] = ()
    """Rows of others."""

    @cached_property
    def constant(self) -> bool:
        """No arm changes."""
        return not (self.functions or self.routed)

    @cached_property
    def _curves(self) -> _Curves:
        return _stacked([function for *_, function in self.functions])

    @cached_property
    def _at(self) -> tuple[list[int], list[int]]:
        return [row for row, *_ in self.functions], [joint for _, joint, _ in self.functions]

    def length(self, q: Array, arms: Array | None = None) -> Array:
        """``l(q)`` ``(*batch, n)``, 0 at zero angles where no tendon has a way of its own."""
        arms = self.typical if arms is None else arms
        found = q @ arms.T
        if self.functions:
            rows, joints = self._at
            share = arms[rows, joints] / self.typical[rows, joints]
            more = share * _evaluate(self._curves, q[..., joints])[0] - arms[rows, joints] * q[..., joints]
            for k, row in enumerate(rows):
                found[..., row] += more[..., k]
        for rows, routed in self.routed:
            length, _ = _each(routed, q)
            found[..., list(rows)] = length * self._shares(arms)[list(rows)]
        return found

    def ratio(self, q: Array) -> Array:
        """``J / arms`` ``(*batch, n, n_q)``; 1 where an arm is constant."""
        found = np.ones((*q.shape[:-1], *self.typical.shape))
        if self.functions:
            rows, joints = self._at
            arm = _evaluate(self._curves, q[..., joints])[1]
            found[..., rows, joints] = arm / self.typical[rows, joints]
        for rows, routed in self.routed:
            at = list(rows)
            whole = self.typical[at]
            J = _each(routed, q)[1]
            found[..., at, :] = np.divide(J, whole, out=np.ones_like(J), where=whole != 0)
        return found

    def jacobian(self, q: Array, arms: Array | None = None) -> Array:
        """``dl/dq`` ``(*batch, n, n_q)``."""
        return (self.typical if arms is None else arms) * self.ratio(q)

    def slope(self, q: Array) -> Array:
        """``d ratio_ij/dq_k`` ``(*batch, n, n_q, n_q)``."""
        n_q = q.shape[-1]
        found = np.zeros((*q.shape[:-1], *self.typical.shape, n_q))
        if self.functions:
            rows, joints = self._at
            bend = _evaluate(self._curves, q[..., joints])[2]
            found[..., rows, joints, joints] = bend / self.typical[rows, joints]
        for rows, routed in self.routed:
            at, shift = list(rows), _STEP * np.eye(n_q)
            ahead, back = (_each(routed, q[..., None, :] + way)[1] for way in (shift, -shift))
            change = np.moveaxis(ahead - back, -3, -1) / (2 * _STEP)
            whole = self.typical[at][..., None]
            found[..., at, :, :] = np.divide(change, whole, out=np.zeros_like(change), where=whole != 0)
        return found

    def curvature(self, q: Array, weight: Array, arms: Array | None = None) -> Array:
        """``sum_i w_i d2l_i/dq2`` ``(*batch, n_q, n_q)``, symmetric.

        Args:
            weight: ``(*batch, n)``.
        """
        arms = self.typical if arms is None else arms
        found = np.einsum("...i,ij,...ijk->...jk", weight, arms, self.slope(q))
        return (found + found.swapaxes(-1, -2)) / 2

    def largest(self, lower: Array, upper: Array) -> Array:
        """Sizes of the arms, at most, within the joints' limits: factors of the given ones ``(n, n_q)``."""
        if self.constant:
            return np.ones_like(self.typical)
        low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
        part = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
        straight = low + part * (high - low)
        mixed = low + np.random.default_rng(0).uniform(size=(_SAMPLES, len(low))) * (high - low)
        return np.abs(self.ratio(np.concatenate([straight, mixed]))).max(axis=0)

    def _shares(self, arms: Array) -> Array:
        """How long each tendon is against the typical one ``(n,)``."""
        square = (self.typical**2).sum(axis=1)
        return np.divide(
            (arms * self.typical).sum(axis=1), square, out=np.ones_like(square), where=square > 0
        )


class _Curves(NamedTuple):
    """Functions of as many pieces and powers, ``(n, ...)``, as :class:`ArmFunction` has them."""

    knots: Array
    origin: Array
    coefficients: Array
    before: Array
    """Integral from 0 to the origin of each piece ``(n, m + 1)``."""


def _stacked(functions: list[ArmFunction]) -> _Curves:
    pieces = max(len(one.origin) for one in functions)
    powers = max(one.coefficients.shape[1] for one in functions)
    knots, origin = np.full((len(functions), pieces - 1), np.inf), np.zeros((len(functions), pieces))
    coefficients = np.zeros((len(functions), pieces, powers))
    for k, one in enumerate(functions):
        knots[k, : len(one.knots)], origin[k, : len(one.origin)] = one.knots, one.origin
        coefficients[k, : len(one.origin), : one.coefficients.shape[1]] = one.coefficients
    before = np.zeros_like(origin)
    raised = coefficients / np.arange(1, powers + 1)
    for p in range(1, pieces):
        step = np.where(np.isfinite(knots[:, p - 1]), knots[:, p - 1], 0.0)
        end = _polynomial(raised[:, p - 1], step - origin[:, p - 1]) * (step - origin[:, p - 1])
        start = _polynomial(raised[:, p], step - origin[:, p]) * (step - origin[:, p])
        before[:, p] = before[:, p - 1] + end - start
    curves = _Curves(knots, origin, coefficients, before)
    return curves._replace(before=before - _evaluate(curves, np.zeros(len(functions)))[0][:, None])


def _evaluate(curves: _Curves, q: Array) -> tuple[Array, Array, Array]:
    """Integrals from 0, arms and their slopes at the angles of each function's joint ``(*batch, n)``."""
    piece = (q[..., None] >= curves.knots).sum(axis=-1)
    at = np.arange(q.shape[-1]), piece
    t, c = q - curves.origin[at], curves.coefficients[at]
    power = np.arange(c.shape[-1])
    slope = _polynomial(c[..., 1:] * power[1:], t)
    return curves.before[at] + _polynomial(c / (power + 1), t) * t, _polynomial(c, t), slope


def _polynomial(c: Array, t: Array) -> Array:
    found = np.zeros_like(t)
    for k in reversed(range(c.shape[-1])):
        found = found * t + c[..., k]
    return found


def _each(routed: Routed, q: Array) -> tuple[Array, Array]:
    """Of every posture of a batch."""
    flat = q.reshape(-1, q.shape[-1])
    lengths, arms = zip(*map(routed, flat), strict=True)
    length, J = np.stack(lengths), np.stack(arms)
    return length.reshape(*q.shape[:-1], -1), J.reshape(*q.shape[:-1], *J.shape[1:])


@dataclass(frozen=True)
class TendonSprings:
    """Springs over tendons: ``V = sum_t k_t/2 (l_t - clip(l_t, low_t, high_t))^2``; no force in between."""

    names: tuple[str, ...]
    lengths: Lengths
    stiffness: Array
    """``(n,)`` [N/m], [N m/rad] where a length is an angle."""
    low: Array
    """Shorter ones push, ``(n,)``; -inf where the tendon only pulls."""
    high: Array
    """Longer ones pull, ``(n,)``."""

    def tension(self, q: Array) -> Array:
        """Pull of each tendon ``(*batch, n)`` [N]; negative: it pushes."""
        length = self.lengths.length(q)
        return self.stiffness * (length - np.clip(length, self.low, self.high))

    def torque(self, q: Array) -> Array:
        """``dV/dq`` ``(*batch, n_q)`` [N m]."""
        return (self.tension(q)[..., None, :] @ self.lengths.jacobian(q))[..., 0, :]

    def stiffness_matrix(self, q: Array) -> Array:
        """``d2V/dq2 = J^T k J + sum_t tension_t d2l_t/dq2`` ``(*batch, n_q, n_q)`` [N m/rad]."""
        tension, J = self.tension(q), self.lengths.jacobian(q)
        k = np.where(tension != 0, self.stiffness, np.where(self.low == self.high, self.stiffness, 0.0))
        return J.swapaxes(-1, -2) @ (k[..., None] * J) + self.lengths.curvature(q, tension)


@dataclass(frozen=True)
class Loops:
    """``c(q) = l(q) - value = 0``: chains that close, joints that follow others along a curve."""

    names: tuple[str, ...]
    lengths: Lengths
    value: Array

    def gap(self, q: Array) -> Array:
        """``c(q)`` ``(*batch, n)``."""
        return self.lengths.length(q) - self.value


def typical_arms(routed: Routed, lower: Array, upper: Array, rest: Array) -> Array:
    """Mean arms ``(n, n_q)`` of lengths on ways of their own; never 0 where they have any."""
    low, high = np.maximum(lower, rest - np.pi), np.minimum(upper, rest + np.pi)
    draw = np.random.default_rng(0).uniform(size=(_SAMPLES, len(low)))
    J = np.stack([routed(q)[1] for q in [rest, *(low + draw * (high - low))]])
    mean, largest = J.mean(axis=0), np.take_along_axis(J, np.abs(J).argmax(axis=0)[None], axis=0)[0]
    found: Array = np.where(np.abs(mean) > _LEAST * np.abs(largest), mean, largest)
    return np.where(np.abs(found) > 1e-12, found, 0.0)
