"""What an update did with a sample, and what a query with derivatives gives."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from ..typing import Bool, Float, Int, Tensor


class UpdateEvent(enum.IntEnum):
    """What an update did with a sample."""

    REFUSED = 0  #: masked out, or not finite under ``on_invalid="skip"``: nothing was learned
    ABSORBED = 1  #: taken in; the learner has no basis, or projected the sample onto it
    ADDED = 2  #: became a new basis vector
    REPLACED = 3  #: became a basis vector, and another was pruned for it


@dataclass(frozen=True)
class UpdateReport:
    """What an update did. All tensors have shape ``(*time, *batch_shape)``.

    Attributes:
        event: an :class:`UpdateEvent` per sample.
        novelty: share of the prior variance at x that the basis does not explain, 0 to 1
            (0 for learners without a basis).
        nis: normalised innovation squared ``i^2 / (v + s2)``, mean over the outputs, before the update
            (a MixtureResidual divides by its running variance, this sample included); expected to be 1
            (NaN for learners without uncertainty).
        weight: weight given to the sample, 1 unless a robust update distrusted it.
    """

    event: Int[Tensor, "*time_and_batch"]
    novelty: Float[Tensor, "*time_and_batch"]
    nis: Float[Tensor, "*time_and_batch"]
    weight: Float[Tensor, "*time_and_batch"]

    @property
    def accepted(self) -> Bool[Tensor, "*time_and_batch"]:
        """Whether each sample was taken in and changed the state."""
        return self.event != UpdateEvent.REFUSED

    @staticmethod
    def of(
        nis: Float[Tensor, "*batch"],
        mask: Bool[Tensor, "*batch"] | None = None,
        weight: Float[Tensor, "*batch"] | None = None,
    ) -> UpdateReport:
        """Of samples that were taken in, by a learner without a basis; by default of weight 1."""
        one = torch.ones_like(nis)
        event = (one if mask is None else mask).to(torch.int64)
        return UpdateReport(event, torch.zeros_like(nis), nis, one if weight is None else weight)

    @staticmethod
    def stack(reports: list[UpdateReport]) -> UpdateReport:
        """Reports of successive samples as one, time first."""
        each = zip(*(vars(report).values() for report in reports), strict=True)
        return UpdateReport(*map(torch.stack, each))

    @staticmethod
    def of_nothing(like: Bool[Tensor, "*batch"], dtype: torch.dtype) -> UpdateReport:
        """The report of a step in which no model had a sample."""
        zero = torch.zeros_like(like, dtype=dtype)
        return UpdateReport(torch.zeros_like(like, dtype=torch.int64), zero, zero, zero)


class MomentsWithJacobians(NamedTuple):
    """Mean and latent variance of g, and their derivatives with respect to x."""

    mean: Float[Tensor, "*any out"]
    variance: Float[Tensor, "*any out"]
    mean_jacobian: Float[Tensor, "*any out in"]
    variance_jacobian: Float[Tensor, "*any out in"]


class Expected(NamedTuple):
    """An input whose target comes late: what :meth:`~torch_ekm.residual.ResidualLearner.expect` gives."""

    x: Float[Tensor, "*batch in"]
    said: Any  #: what the learner said then of its target, None where that does not matter
