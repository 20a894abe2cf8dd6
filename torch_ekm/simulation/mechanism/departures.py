"""How a transmission departs from round pulleys, linear springs and cables without losses."""

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


@dataclass(frozen=True)
class CableLosses:
    """Friction, hysteresis and coupling of the transmissions, and play of the joints::

        |tau_f| <= friction + capstan |arm^T T|             Coulomb friction of the joint and of its cables
        T  = K s + z,  |z| <= (hysteresis/2) k |s|,  dz = k ds while it may grow
        K^-1 = D (I + coupling (1 1^T - I)) D,  D = diag(k)^(-1/2)
        no torque goes through a joint while it is within its play

    Source: a cable round a pulley over the angle w loses the share ``1 - exp(-mu w)`` of its tension (Euler
    and Eytelwein): capstan; the elastic hysteresis is that of Masing (1926) with one element; actuators on
    one frame that gives way are springs in series with a common one: coupling.
    """

    capstan: float
    hysteresis: float
    coupling: float
    play: Array
    """Full width of each joint ``(n_q,)`` [rad]."""

    def compliance(self, stiffness: Array) -> Array:
        """``K^-1`` ``(n_a, n_a)`` [rad/(N m)] of actuators with stiffness k ``(n_a,)`` [N m/rad]."""
        root = 1 / np.sqrt(stiffness)
        shared = self.coupling + (1 - self.coupling) * np.eye(len(stiffness))
        return root[:, None] * shared * root
