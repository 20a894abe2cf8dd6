"""Friction cones: exact norm, polyhedra around them, cutting planes.

Point contact with friction ``|f_t| <= mu_s f_n``; soft finger ``(|f_t|/mu_s)^2 + (m_n/gamma)^2 <= f_n^2``.
Both read ``|u| <= mu_s f_n`` with ``u = [f_t; m_n mu_s/gamma]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...typing import Array
from ..contact_model import ContactModel


@dataclass(frozen=True)
class FrictionCone:
    """Cone of one contact inside the stacked force vector ``mu``."""

    start: int
    """Position of the normal force in ``mu``; the friction components follow it."""
    scale: Array
    """Diagonal that makes ``u`` of the friction components, ``(d,)``: 1, 1, mu_s/gamma."""
    mu_s: float

    @property
    def dim(self) -> int:
        """Number of friction components d: 0 (frictionless), 1 (planar), 2 (point contact), 3 (soft)."""
        return len(self.scale)

    def u(self, mu: Array) -> Array:
        """Friction components ``u`` of the force vector, scaled to newtons."""
        return self.scale * mu[..., self.start + 1 : self.start + 1 + self.dim]

    def slack(self, mu: Array) -> float:
        """``mu_s f_n - |u|`` [N]; negative: outside the cone."""
        return float(self.mu_s * mu[self.start] - np.linalg.norm(self.u(mu)))

    def rows(self, directions: Array, n_h: int) -> Array:
        """Rows ``g`` of ``g mu <= 0``: ``d . u <= mu_s f_n`` for each direction ``(k, d)``."""
        rows = np.zeros((len(directions), n_h))
        rows[:, self.start] = -self.mu_s
        rows[:, self.start + 1 : self.start + 1 + self.dim] = directions * self.scale
        return rows


def friction_cones(
    models: Sequence[ContactModel], mu_s: Sequence[float], gamma: Sequence[float]
) -> tuple[FrictionCone, ...]:
    """The cones of contacts whose components are stacked in the order of the models' rows."""
    cones, start = [], 0
    for model, friction, torsional in zip(models, mu_s, gamma, strict=True):
        scale = np.ones(len(model.rows) - 1)
        if model is ContactModel.SOFT_FINGER:
            scale[2] = friction / max(torsional, 1e-9)
        cones.append(FrictionCone(start, scale, float(friction)))
        start += len(model.rows)
    return tuple(cones)


@lru_cache(maxsize=4)
def outer_directions(dim: int) -> Array:
    """Unit normals d of a polyhedron ``{d . u <= 1}`` around the unit ball, ``(k, dim)``.

    Eight around a circle; for a soft finger rings of eight over the latitudes and the two poles.
    """
    if dim == 0:
        return np.zeros((0, 0))
    if dim == 1:
        return np.array([[1.0], [-1.0]])
    angle = 2 * np.pi * np.arange(8) / 8
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if dim == 2:
        return ring
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 5)[1:-1]
    layers = [np.concatenate([np.cos(t) * ring, np.full((8, 1), np.sin(t))], axis=-1) for t in latitude]
    return np.concatenate([*layers, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])


def cutting_planes(cones: Sequence[FrictionCone], mu: Array, tolerance: float) -> Array:
    """Rows ``g mu <= 0`` that cut off ``mu`` where it violates a cone by more than ``tolerance`` [N]."""
    cuts = [np.zeros((0, len(mu)))]
    for cone in cones:
        if cone.dim > 1 and cone.slack(mu) < -tolerance:
            u = cone.u(mu)
            cuts.append(cone.rows((u / np.linalg.norm(u))[None], len(mu)))
    return np.concatenate(cuts)


def margins(cones: Sequence[FrictionCone], mu: Array) -> tuple[Array, Array]:
    """Per contact ``mu_s f_n - |u|`` [N], and that relative to ``mu_s f_n``: 1 no friction used, 0 slips."""
    slack = np.array([cone.slack(mu) for cone in cones])
    limit = np.array([cone.mu_s * mu[cone.start] for cone in cones])
    relative = np.divide(slack, limit, out=np.zeros_like(slack), where=limit > 1e-12)
    return slack, relative
