"""Small dense quadratic programs whose active constraints are few."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...typing import Array

_MOST_CHANGES = 25
_VIOLATED = 1e-10  # of rows of the order of 1
_ERROR = 1e-9


class EqualityProgram:
    """``min 1/2 x^T P x + q^T x, A x = b``, solved again and again with more rows.

    Raises:
        numpy.linalg.LinAlgError: rows of A depend on each other, or P is singular on their null space.
    """

    def __init__(self, P: Array, q: Array, A: Array, b: Array) -> None:
        self._n, m = len(q), len(b)
        self._K = np.zeros((self._n + m, self._n + m))
        self._K[: self._n, : self._n] = P
        self._K[: self._n, self._n :], self._K[self._n :, : self._n] = A.T, A
        self._inverse = np.linalg.inv(self._K)
        self._right = np.concatenate([-q, b])  # of the conditions for x and the multipliers of A
        z = self._inverse @ self._right
        self._z = z + self._inverse @ (self._right - self._K @ z)  # refined: rounding of a poor condition
        self.x: Array = self._z[: self._n]
        """The optimum."""

    def solve(self, E: Array, e: Array) -> tuple[Array, Array, Any]:
        """The optimum with ``E x = e`` on top, and the multipliers of A and of E.

        Raises:
            numpy.linalg.LinAlgError: the rows depend on each other and on A.
        """
        n, H_E = self._n, self._inverse[:, : self._n] @ E.T
        lam = np.linalg.solve(E @ H_E[:n], E @ self.x - e)
        z = self._z - H_E @ lam
        return z[:n], z[n:], lam

    def error(self, x: Array, nu: Array, push: Array) -> float:
        """``max(|P x + q + A^T nu + push|, |A x - b|)`` as a share of the largest of q and b, or of 1."""
        left = self._right - self._K @ np.concatenate([x, nu])
        left[: self._n] -= push
        return float(abs(left).max() / max(1.0, abs(self._right).max()))


class Optimum(NamedTuple):
    """x, and what certifies it."""

    x: Array
    equality: Array
    """nu, multipliers of ``A x = b``."""
    active: list[int]
    """W, rows of G that hold with equality."""
    inequality: Array
    """lam, their multipliers."""


def solve_by_active_set(program: EqualityProgram, G: Array, h: Array, active: list[int]) -> Optimum | None:
    """The optimum with ``G x <= h``, by guessing which rows W hold with equality::

        P x + q + A^T nu + G_W^T lam = 0,  A x = b,  G_W x = h_W,  lam >= 0,  G x <= h

    From one guess to the next the row with the most negative multiplier leaves, or else the row that is
    violated most enters. An answer keeps all conditions of Karush, Kuhn and Tucker and is exact to rounding;
    where none is found (None) an interior-point method has to do it. At a vertex, where as many rows hold as
    there are unknowns, rounding decides which row leaves, and none may be found. See Nocedal and Wright,
    Numerical Optimization (2006), ch. 16.

    Args:
        active: the first guess.
    """
    rows = list(active)
    for _ in range(_MOST_CHANGES):
        try:
            x, nu, lam = program.solve(G[rows], h[rows])
        except np.linalg.LinAlgError:
            return None
        if len(rows) and lam.min() < 0:
            del rows[int(lam.argmin())]
            continue
        broken = G @ x - h
        broken[rows] = 0.0
        if broken.max(initial=0.0) <= _VIOLATED:
            right = program.error(x, nu, lam @ G[rows]) <= _ERROR  # not so where A is nearly singular
            return Optimum(x, nu, rows, lam) if right else None
        rows.append(int(broken.argmax()))
    return None
