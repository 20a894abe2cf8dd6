"""The contacts of a grasp, as data: what a collision detector hands to the model."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from ..exceptions import ShapeError
from ..typing import Float, Tensor

CHARACTERISTIC_LENGTH = 0.03
"""L [m], size of a held object: what makes lengths comparable with angles, and moments with forces."""


@dataclass(frozen=True)
class NearMiss:
    """What is near the object and counts as no contact: a pad beyond the margin, or a link that is no pad."""

    link: str
    pad: str | None
    """None: a link, with which the model does not reckon."""
    gap: float
    """Signed distance to the object [m]."""


@dataclass(frozen=True)
class ContactSet:
    """``n_c`` contacts between finger links and the object, in the hand frame.

    The same links touch over a whole batch; only numbers vary along ``*batch``.
    Curvature tensors live in the tangent plane (``K n = 0``) and are positive for convex
    bodies; 0 is flat, and an infinitely sharp (pinned) contact is said by ``pinned``.
    """

    finger: tuple[str, ...]
    """Name of the contact pad of each contact."""
    link: tuple[str, ...]
    """Link that carries it."""
    point: Float[Tensor, "*batch n_c 3"]
    """x_i, contact point [m]."""
    normal: Float[Tensor, "*batch n_c 3"]
    """n_i, outward normal of the **object**; the finger presses along ``-n_i``."""
    gap: Float[Tensor, "*batch n_c"]
    """Signed distance between the surfaces [m]; negative: they overlap."""
    finger_curvature: Float[Tensor, "*batch n_c 3 3"]
    """K_f [1/m]."""
    object_curvature: Float[Tensor, "*batch n_c 3 3"]
    """K_o [1/m]."""
    friction: Float[Tensor, " n_c"]
    """Coulomb coefficient mu_s of each contact."""
    torsional_friction: Float[Tensor, " n_c"]
    """Soft-finger coefficient gamma [m]; 0: a point contact with friction."""
    pinned: tuple[bool, ...] = ()
    """Contact is a material point of both bodies (sharp tip or edge): no rolling term."""
    near_misses: tuple[NearMiss, ...] = ()
    """What the detector left out."""

    def __post_init__(self) -> None:
        n_c = len(self.finger)
        if not self.pinned:
            object.__setattr__(self, "pinned", (False,) * n_c)
        for name, tail in (("point", (n_c, 3)), ("normal", (n_c, 3)), ("gap", (n_c,))):
            shape = tuple(getattr(self, name).shape)
            if shape[len(shape) - len(tail) :] != tail:
                expected = "(*batch, " + ", ".join(str(k) for k in tail) + ")"
                raise ShapeError(f"ContactSet.{name}", expected, shape)

    @property
    def n_c(self) -> int:
        """Number of contacts."""
        return len(self.finger)

    @property
    def batch_shape(self) -> torch.Size:
        return self.gap.shape[:-1]

    def replace(self, **changes: object) -> ContactSet:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]
