"""How a transmission departs from round pulleys and linear springs."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ...typing import Array


@dataclass(frozen=True)
class JointShape:
    """How far pulleys are from round, and springs from linear::

        h_j(q) = q - (v/2) (cos(2 q + phase_j) - cos phase_j)      excursion J_a h(q), arms J_a h'(q)
        k x (1 + s x^2)                                            x from the spring's rest

    Source: the arm of a tendon is the derivative of its excursion, An et al., J. Biomech. 16 (1983); the
    cubic spring is that of Duffing (1918).
    """

    variation: Array
    """v of each joint ``(n_q,)``."""
    phase: Array
    """Of each joint ``(n_q,)`` [rad]."""
    stiffening: float
    """s [1/rad^2]."""

    @functools.cached_property
    def _round(self) -> bool:
        return not self.variation.any()

    def excursion(self, q: Array) -> Array:
        """h(q) ``(*batch, n_q)`` [rad]; with round pulleys q itself."""
        if self._round:  # asked at every time step
            return q
        return q - 0.5 * self.variation * (np.cos(2 * q + self.phase) - np.cos(self.phase))

    def arm(self, q: Array) -> Array:
        """h'(q) ``(*batch, n_q)``."""
        if self._round:
            return np.ones_like(q)
        return 1 + self.variation * np.sin(2 * q + self.phase)

    def spring(self, x: Array) -> Array:
        """``x (1 + s x^2)`` ``(*batch, n_q)`` [rad]; of a linear spring x itself."""
        return x if self.stiffening == 0 else x * (1 + self.stiffening * x**2)
