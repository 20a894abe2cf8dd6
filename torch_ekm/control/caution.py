"""When a closed loop looks again, goes back, and gives up with the object in the hand."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..exceptions import ParameterError
from ..model import ModelStatus

if TYPE_CHECKING:
    from ..model import Linearization

_DEG = math.pi / 180


@dataclass(frozen=True)
class Caution:
    """What tells of a loss before it comes, and what is done then; the same for every controller.

    Signs: the model refuses the state; the object has turned off the focus by ``off_rotation``; a link
    without a pad comes to bear on the object. One that ``looks`` further readings show as well is heeded:
    the hand goes back along the way that was come, motion by motion, until the signs are gone, for these
    states are known to hold. It grips by ``tighten`` more and tries again at a smaller pace, ``retreats``
    times; at the next sign it goes back once more and gives up. Where going back does not help, it gives up
    at once.
    """

    looks: int = 2
    """Further readings before a sign is believed."""
    off_rotation: float = 8 * _DEG
    """[rad]"""
    off_further: float = 4 * _DEG
    """An object that has slid does not come back: after a sign it may turn so much further [rad]."""
    link_gap: float = 0.2e-3
    """A link without a pad as near to the object as this counts, unless it was so near at the start [m]."""
    retreats: int = 1
    way_back: int = 4
    """Motions of one retreat at most."""
    tighten: float = 1.0
    """[N]"""

    def __post_init__(self) -> None:
        for name in ("looks", "off_rotation", "off_further", "retreats", "way_back", "tighten"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "0 or more")

    def bearing_links(self, lin: Linearization | None) -> frozenset[str]:
        """Links without a pad that bear on the object."""
        doubts: Iterable = () if lin is None else lin.doubts
        near = (doubt for doubt in doubts if doubt.kind is ModelStatus.LINK_TOUCHES)
        return frozenset(doubt.what for doubt in near if doubt.value < self.link_gap)

    def sign(self, off_rotation: float, allowed: float, bearing: frozenset[str]) -> str:
        """What speaks for a loss to come; empty: nothing.

        Args:
            off_rotation, allowed: of the object since the start [rad].
            bearing: links without a pad that bear on the object and did not at the start.
        """
        if off_rotation > allowed:
            return f"the object has turned {off_rotation / _DEG:.1f} deg off the focus"
        return f"link '{min(bearing)}', which has no pad, bears on the object" if bearing else ""
