"""Poses of all links of a hand, as the forward kinematics returns them."""

from __future__ import annotations

from dataclasses import dataclass

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
