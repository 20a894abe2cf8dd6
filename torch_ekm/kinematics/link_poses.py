"""Poses of all links of a hand, and what gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch

from ..exceptions import UnknownNameError
from ..typing import Float, Tensor


@dataclass(frozen=True)
class LinkPoses:
    """``T_hand_link`` of every link, in the order of ``link_names``."""

    transforms: Float[Tensor, "*batch n_link 4 4"]
    """Homogeneous transforms [m], link frame to hand frame."""
    link_names: tuple[str, ...]

    def of(self, name: str) -> Float[Tensor, "*batch 4 4"]:
        """Pose of one link.

        Raises:
            UnknownNameError: there is no such link; the message lists all.
        """
        if name not in self.link_names:
            raise UnknownNameError("link", name, self.link_names)
        return self.transforms[..., self.link_names.index(name), :, :]


@runtime_checkable
class Kinematics(Protocol):
    """Forward kinematics of a hand in the hand frame: :class:`HandKinematics` or one's own."""

    @property
    def link_names(self) -> tuple[str, ...]: ...

    @property
    def upstream(self) -> Tensor:
        """``[link, joint]``: the joint moves the link, bool ``(n_link, n_q)``."""
        ...

    @property
    def dtype(self) -> torch.dtype: ...

    def __call__(self, q: Tensor, /) -> LinkPoses:
        """Poses of all links at joint angles [rad]."""
        ...

    def joint_axes(self, poses: LinkPoses, /) -> tuple[Tensor, Tensor]:
        """Unit axis of every joint and a point on it [m], ``(*batch, n_q, 3)`` each."""
        ...
