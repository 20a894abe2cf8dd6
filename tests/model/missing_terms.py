"""The kinematic model without terms of its stiffness, to see what each of them is worth."""

from __future__ import annotations

import copy
import dataclasses

import torch

from torch_ekm.contact.contact_kinematics import ContactKinematics
from torch_ekm.kinematics.se3 import hat
from torch_ekm.model import KinematicModel
from torch_ekm.model.stiffness.potential import posture_stiffness


class _Without(KinematicModel):
    """Leaves out ``S`` (lever arms of the hand), ``T`` (of the object), or both."""

    terms: tuple[str, ...] = ()

    def load_stiffness(
        self, kin: ContactKinematics, force: torch.Tensor, spin_moment: torch.Tensor
    ) -> torch.Tensor:
        D, n_q = super().load_stiffness(kin, force, spin_moment), self.hand.n_q
        if "S" in self.terms:
            arms = kin.point_jacobian.mT
            D[..., :n_q, :n_q] -= posture_stiffness(force, arms, kin.axis, self.precedes)
        if "T" in self.terms:
            D[..., n_q + 3 :, n_q + 3 :] += (hat(force) @ hat(kin.lever)).sum(-3)
        return D


def without(model: KinematicModel, *terms: str) -> KinematicModel:
    """The model without some of ``"S"``, ``"T"`` and ``"rolling"``; instability is flagged."""
    options = dataclasses.replace(model.options, on_unstable="flag", rolling="rolling" not in terms)
    parts = {"kinematics": model.kinematics, "detector": model.detector}
    less = _Without(model.hand, copy.copy(model.obj), options, **parts)
    less.terms = terms
    return less
