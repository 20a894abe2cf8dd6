"""Which components of force and moment a contact transmits: the selection matrix ``H``."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from .contact_set import ContactSet


class ContactModel(Enum):
    """Rows of a contact's six components ``[f_n, f_t1, f_t2, m_n, m_t1, m_t2]`` that it transmits."""

    FRICTIONLESS = (0,)
    POINT_WITH_FRICTION = (0, 1, 2)
    """Point contact with friction, also called hard finger."""
    PLANAR_POINT_WITH_FRICTION = (0, 1)
    """The same in a planar hand: ``t1`` lies in the plane of motion."""
    SOFT_FINGER = (0, 1, 2, 3)
    """And a moment about the normal."""

    @property
    def rows(self) -> tuple[int, ...]:
        return self.value


def contact_models(contacts: ContactSet, *, planar: bool = False) -> tuple[ContactModel, ...]:
    """The model that each contact's coefficients ask for.

    No friction: frictionless. Else, in a planar hand: planar point contact with friction; in space a soft
    finger if the torsional coefficient ``gamma > 0``, else a point contact with friction.
    """
    models = []
    for mu_s, gamma in zip(contacts.friction.tolist(), contacts.torsional_friction.tolist(), strict=True):
        if mu_s <= 0:
            models.append(ContactModel.FRICTIONLESS)
        elif planar:
            models.append(ContactModel.PLANAR_POINT_WITH_FRICTION)
        else:
            models.append(ContactModel.SOFT_FINGER if gamma > 0 else ContactModel.POINT_WITH_FRICTION)
    return tuple(models)


def selected_rows(models: Sequence[ContactModel]) -> list[int]:
    """Indices into the ``6 n_c`` stacked components that ``H`` keeps (``n_h`` of them).

    ``J_h = H J~_h`` and ``G = G~ H^T`` (Prattichizzo and Trinkle, Grasping, 2008).
    """
    return [6 * i + row for i, model in enumerate(models) for row in model.rows]
