"""How much of a pose error one step asks for."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..typing import Float, Tensor
from .qp import DEGREE


@dataclass(frozen=True)
class LimitingFunction:
    """``dx_d = e min(gain, p step/|e|, p contact_travel/|v(e)|)``: keeps the direction, linear near the goal.

    v(e) is the way that the whole error would carry the contact that moves most. The limiting function of the
    E-KM paper (section III.B) is that of ``step``; the other two hold off noise and wide objects.
    The pace p is 1 unless a :class:`~torch_ekm.enhanced.TrustRegion` sets it.
    """

    gain: float = 0.8
    """Share of a small focused error that one step asks for. A model that is right meets all of it,
    camera noise included; below 1 the loop averages the noise over some steps."""
    step: float = 2.5 * DEGREE
    """At most this much of the focused error is asked for in one step [unit of the focus]."""
    contact_travel: float | None = 1.2e-3
    """And no contact is asked to move farther than this [m]: a wide object turns in smaller steps.
    None: no such limit."""

    def __call__(
        self, error: Float[Tensor, " n_x"], travel: float = 0.0, pace: float = 1.0
    ) -> Float[Tensor, " n_x"]:
        """dx_d.

        Args:
            error: e, focused error.
            travel: ``|v(e)|``, see :func:`contact_travel` [m].
            pace: p.
        """
        size = self.steps(error, travel)
        return error * min(self.gain, pace / size) if size > 0 else error

    def steps(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> float:
        """How many of the largest steps, at pace 1, make up an error."""
        size = float(torch.linalg.vector_norm(error)) / self.step
        return size if self.contact_travel is None else max(size, travel / self.contact_travel)


def contact_travel(twist: Float[Tensor, " 6"], lever: Float[Tensor, "n_c 3"]) -> float:
    """``max_i |v + w x l_i|`` of contacts at l from the object's point o [m]."""
    v, w = twist.split(3)
    carried = v + torch.linalg.cross(w.expand_as(lever), lever)
    return float(torch.linalg.vector_norm(carried, dim=-1).max())


def contact_lever(lever: Float[Tensor, "n_c 3"]) -> float:
    """Root mean square distance of the contacts from the object's point [m]."""
    return float(lever.square().sum(-1).mean().sqrt())
