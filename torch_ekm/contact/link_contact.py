"""Which links that are no pads touch the object: the model does not reckon with them, so it must say so."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..description import HandDescription
from ..typing import Array
from .contact_set import NearMiss
from .pad_contact import Solid


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
        self.margin, self._distance = margin, distance
        self._shapes: list[tuple[int, str, Solid]] = [
            (hand.link_names.index(link.name), link.name, Solid(coal, shape))
            for link in hand.urdf.links
            if link.name not in carry_pads
            for shape in link.collisions
        ]
        for _, _, solid in self._shapes:
            solid.geometry.computeLocalAABB()
        self._links = [index for index, *_ in self._shapes]
        self._centres = np.array([[*solid.shape.transform[:3, 3], 1.0] for _, _, solid in self._shapes])

    def touching(self, frames: Array, solids: list[tuple[Solid, Array]]) -> list[NearMiss]:
        """The links that touch, one entry for each.

        Args:
            frames: poses of all links ``(n_link, 4, 4)``.
            solids: the object's primitives with their poses.
        """
        found: dict[str, float] = {}
        if not self._shapes:
            return []
        centres = (frames[self._links] @ self._centres[:, :, None])[:, :3, 0]
        for solid, T in solids:
            near = (centres - T[:3, 3]) @ T[:3, :3]
            for (index, link, shape), centre in zip(self._shapes, near.tolist(), strict=True):
                if solid.distance(*centre)[0] > shape.geometry.aabb_radius + self.margin:
                    continue
                gap = self._distance(shape, frames[index] @ shape.shape.transform, solid, T)
                if gap <= min(self.margin, found.get(link, self.margin)):
                    found[link] = gap
        return [NearMiss(link, None, gap) for link, gap in found.items()]
