"""Which components of force and moment a contact transmits: the selection matrix ``H``."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import torch

from ..typing import Float, Tensor
from .contact_set import ContactSet


class ContactModel(Enum):
    """Rows of a contact's six components ``[f_n, f_t1, f_t2, m_n, m_t1, m_t2]`` that it transmits."""

    FRICTIONLESS = (0,)
    HARD_FINGER = (0, 1, 2)
    SOFT_FINGER = (0, 1, 2, 3)
    PLANAR_HARD_FINGER = (0, 1)
    """Hard finger of a planar hand: ``t1`` lies in the plane of motion."""

    @property
    def rows(self) -> tuple[int, ...]:
        return self.value


def contact_models(contacts: ContactSet, *, planar: bool = False) -> tuple[ContactModel, ...]:
    """The model that each contact's coefficients ask for.

    No friction: frictionless; a torsional coefficient ``gamma > 0``: soft finger; else hard finger.
    """
    models = []
    for mu_s, gamma in zip(contacts.friction.tolist(), contacts.torsional_friction.tolist(), strict=True):
        if mu_s <= 0:
            models.append(ContactModel.FRICTIONLESS)
        elif planar:
            models.append(ContactModel.PLANAR_HARD_FINGER)
        else:
            models.append(ContactModel.SOFT_FINGER if gamma > 0 else ContactModel.HARD_FINGER)
    return tuple(models)


def selected_rows(models: Sequence[ContactModel]) -> list[int]:
    """Indices into the ``6 n_c`` stacked components that ``H`` keeps (``n_h`` of them)."""
    return [6 * i + row for i, model in enumerate(models) for row in model.rows]


def normal_rows(models: Sequence[ContactModel]) -> list[int]:
    """Where each contact's normal force stands in ``mu``: ``n_c`` indices."""
    starts, at = [], 0
    for model in models:
        starts.append(at)
        at += len(model.rows)
    return starts


def selection_matrix(
    models: Sequence[ContactModel], dtype: torch.dtype = torch.float64
) -> Float[Tensor, "n_h 6*n_c"]:
    """``H`` with ``J_h = H J~_h`` and ``G = G~ H^T`` (Prattichizzo and Trinkle, Grasping, 2008)."""
    return torch.eye(6 * len(models), dtype=dtype)[selected_rows(models)]
