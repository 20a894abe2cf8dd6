"""The contacts of a grasp, as data: what a collision detector hands to the model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch

from .._arrays import as_tensors
from ..exceptions import NonFiniteError, ParameterError, ShapeError
from ..typing import Float, Tensor

CHARACTERISTIC_LENGTH = 0.03
"""L [m], size of a held object: what makes lengths comparable with angles, and moments with forces."""
LINK_MARGIN = 0.001
"""Gap up to which a link that is no pad is reported as touching [m]."""
_UNIT = 1e-4
"""How far the length of a normal may be from 1."""
_TAILS: dict[str, tuple[int, ...]] = {
    "point": (3,),
    "normal": (3,),
    "gap": (),
    "finger_curvature": (3, 3),
    "object_curvature": (3, 3),
    "friction": (),
    "torsional_friction": (),
}
#: Fields that do not vary over a batch.
SHARED = ("friction", "torsional_friction")
#: The others, with the number of their dimensions for one contact set.
VARYING = {name: 1 + len(tail) for name, tail in _TAILS.items() if name not in SHARED}


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
    Arrays and nested lists are converted, and all fields get the widest of their precisions.

    Raises:
        ShapeError: the fields do not belong together.
        ParameterError: a field that is not made of numbers.
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
    """K_f, curvature of the finger pad at the contact [1/m]."""
    object_curvature: Float[Tensor, "*batch n_c 3 3"]
    """K_o, curvature of the object's surface there [1/m]."""
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
        given = {name: getattr(self, name) for name in _TAILS}
        for name, value in zip(given, as_tensors(**given), strict=True):
            object.__setattr__(self, name, value)  # the dataclass is frozen
        if not self.pinned:
            object.__setattr__(self, "pinned", (False,) * n_c)
        for name, tail in _TAILS.items():
            shape, expected = tuple(getattr(self, name).shape), (n_c, *tail)
            if shape[-len(expected) :] != expected:
                raise ShapeError(f"ContactSet.{name}", f"(*batch, {', '.join(map(str, expected))})", shape)
        for name in ("link", "pinned"):
            if len(getattr(self, name)) != n_c:
                raise ShapeError(f"ContactSet.{name}", f"{n_c} entries", (len(getattr(self, name)),))

    def check(self) -> None:
        """The numbers must make sense; apart from the constructor, which also runs where tensors have none.

        Raises:
            NonFiniteError: a NaN or an infinity; ``pinned`` says that a contact is infinitely sharp.
            ParameterError: a normal that is no unit vector, or a negative coefficient of friction.
        """
        if not bool(torch.isfinite(torch.cat([getattr(self, name).flatten() for name in _TAILS])).all()):
            name = next(name for name in _TAILS if not bool(torch.isfinite(getattr(self, name)).all()))
            raise NonFiniteError(f"contacts.{name}")
        size = torch.linalg.vector_norm(self.normal, dim=-1).flatten().tolist()
        if size and not (min(size) > 1 - _UNIT and max(size) < 1 + _UNIT):
            worst = max(range(len(size)), key=lambda k: abs(size[k] - 1))
            where = f"contacts.normal of '{self.finger[worst % self.n_c]}'"
            normal = self.normal.reshape(-1, 3)[worst].tolist()
            raise ParameterError(where, normal, f"of unit length, not {size[worst]:.4g}")
        for name in ("friction", "torsional_friction"):
            for finger, value in zip(self.finger, getattr(self, name).tolist(), strict=True):
                if value < 0:
                    raise ParameterError(f"contacts.{name} of '{finger}'", value, "not negative")

    @property
    def n_c(self) -> int:
        """Number of contacts, the same for all states of a batch."""
        return len(self.finger)

    @property
    def batch_shape(self) -> torch.Size:
        return self.gap.shape[:-1]

    def select(self, index: Sequence[int]) -> ContactSet:
        """Some of the contacts, in the order of ``index``."""
        at = list(index)
        parts = {
            name: getattr(self, name).movedim(-1 - len(tail), 0)[at].movedim(0, -1 - len(tail))
            for name, tail in _TAILS.items()
        }
        names = {name: tuple(getattr(self, name)[i] for i in at) for name in ("finger", "link", "pinned")}
        return self.replace(**parts, **names)

    def replace(self, **changes: Any) -> ContactSet:
        """A copy with the given fields changed, checked like a new set."""
        return dataclasses.replace(self, **changes)


@runtime_checkable
class Detector(Protocol):
    """Finds the contacts of one state, hand frame: :class:`ContactDetector` or one's own."""

    def __call__(self, q: Tensor, position: Tensor, rotation: Tensor, /) -> ContactSet: ...
