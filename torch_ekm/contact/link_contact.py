"""Where links that are no pads touch the object."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ..description import HandDescription
from ..typing import Array
from .contact_set import NearMiss
from .pad_contact import LinkCapsule, PadContact, Solid, flat_contact, pad_contact


class LinkShapes:
    """The collision shapes of all links without a pad, each in a bounding ball.

    A link is far where ``d(c) > r + margin``, c and r centre and radius of the ball and d the signed
    distance to the object; only what is near is given to coal.

    Args:
        coal: the module.
        hand: its links.
        margin: largest gap that is reported [m].
        distance: signed distance of two solids at two poses [m].
    """

    def __init__(self, coal, hand: HandDescription, margin: float, distance: Callable[..., float]) -> None:
        carry_pads = {pad.link for pad in hand.pads}
        self.margin, self._distance, self._coal = margin, distance, coal
        self._shapes: list[tuple[int, str, Solid]] = [
            (hand.link_names.index(link.name), link.name, Solid(coal, shape))
            for link in hand.urdf.links
            if link.name not in carry_pads
            for shape in link.collisions
        ]
        for _, _, solid in self._shapes:
            solid.geometry.computeLocalAABB()
        self._round = [
            LinkCapsule(solid) if solid.shape.kind in ("capsule", "sphere") else None
            for _, _, solid in self._shapes
        ]
        self._links = [index for index, *_ in self._shapes]
        self._centres = np.array([[*solid.shape.transform[:3, 3], 1.0] for _, _, solid in self._shapes])

    def touching(self, frames: Array, solids: list[tuple[Solid, Array]]) -> list[NearMiss]:
        """The links that touch, one entry for each.

        Args:
            frames: poses of all links ``(n_link, 4, 4)``.
            solids: the object's primitives with their poses.
        """
        found: dict[str, float] = {}
        for place, solid, T in self._near(frames, solids, self.margin):
            index, link, shape = self._shapes[place]
            gap = self._distance(shape, frames[index] @ shape.shape.transform, solid, T)
            if gap <= min(self.margin, found.get(link, self.margin)):
                found[link] = gap
        return [NearMiss(link, None, gap) for link, gap in found.items()]

    def contacts(
        self, frames: Array, solids: list[tuple[Solid, Array]], margin: float, crown_radius: float
    ) -> list[tuple[str, PadContact]]:
        """Links within ``margin`` [m] of the object, each with the contact of its smallest gap, in the order
        of the hand's links; arguments as of :meth:`touching` and :func:`pad_contact`."""
        found: dict[str, PadContact] = {}
        for place, solid, T in self._near(frames, solids, margin):
            index, link, shape = self._shapes[place]
            capsule, T_link = self._round[place], frames[index] @ shape.shape.transform
            if capsule is not None:
                one = pad_contact(capsule, T_link, solid, T, crown_radius, margin)
            else:
                one = flat_contact(self._coal, shape, T_link, solid, T)
            if one is not None and one.gap <= margin and (link not in found or one.gap < found[link].gap):
                found[link] = one
        return [
            (link, found[link])
            for link in dict.fromkeys(name for _, name, _ in self._shapes)
            if link in found
        ]

    def _near(
        self, frames: Array, solids: list[tuple[Solid, Array]], margin: float
    ) -> Iterator[tuple[int, Solid, Array]]:
        """Shapes whose balls are within ``margin`` of a primitive of the object."""
        if not self._shapes:
            return
        centres = (frames[self._links] @ self._centres[:, :, None])[:, :3, 0]
        for solid, T in solids:
            near = (centres - T[:3, 3]) @ T[:3, :3]
            for place, centre in enumerate(near.tolist()):
                if solid.distance(*centre)[0] <= self._shapes[place][2].geometry.aabb_radius + margin:
                    yield place, solid, T
