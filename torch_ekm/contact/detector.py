"""Contacts from joint angles and object pose: where the finger pads meet the object's primitives.

coal finds what is near; the contact point, normal and curvatures are then computed in closed form,
because the witness points of a distance query jump along a line of contact.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection
from typing import Any

import numpy as np
import torch

from .._checks import check_finite, check_shape
from .._extras import require
from ..description import HandDescription, ObjectDescription
from ..exceptions import DescriptionError, ParameterError, ShapeError
from ..kinematics import HandKinematics, LinkPoses
from ..kinematics.poses import Kinematics
from ..typing import Array, Float, Tensor
from .contacts import LINK_MARGIN, ContactSet, NearMiss
from .pad_contact import LinkShapes, PadContact, Solid, pad_contact, pad_shape

CROWN_RADIUS = 0.5
"""R, of a pad along its axis [m]."""
PRESSING = 0.006
"""Gap up to which a pad touches that measures a force [m]."""
Touch = tuple[str, str, float, PadContact]
"""Pad (or link without one), link, coefficient of torsional friction, contact."""


class ContactDetector:
    r"""One contact per (pad, object): ``s* = argmin_s d(c(s)) + s^2/(2 R)``, ``x = c(s*) - (rho + gap/2) n``.

    ``c(s) = m + s t`` is the axis of the pad's capsule (radius ``rho``), ``d`` the signed distance to the
    object, ``n = grad d`` the object's outward normal and ``gap = d(c(s*)) - rho``. ``d`` is convex for a
    convex primitive, also inside it, so deep overlaps need no other method. The second term gives the pad a
    slight crown (radius ``R`` along its axis): without it a capsule lying on a flat face has no single
    contact point, and the point would jump from one end to the other as the finger tilts. With it, ``s*`` is
    a continuous function of the state, ``|ds*/dtilt| <= R``. Where the object is curved along the pad by k,
    the crown is ``max(0, 1/R - k)``: none where it is curved at all, but all of it at an edge, beyond which
    a flat face may lie along the pad. Where the pad touches with a round end, and for balls, the crown
    plays no part.

    The contact point lies midway between the two surfaces. Curvatures: pad ``1/rho`` across and
    the crown along its axis on the side, ``1/rho`` all around on a round end; object from the feature
    that is touched (face 0, cylinder ``1/radius`` across, ...), an edge or corner is ``pinned``.
    Of an object made of several primitives the nearest one counts.

    Args:
        hand: its pads make contacts; of its other links those that touch are reported as near misses.
        obj: the object.
        margin: pads farther away than this [m] are left out, and reported so; ``math.inf`` keeps them all.
        kinematics: of the same hand, to share one; made here if None.

    Raises:
        MissingExtraError: coal is not installed.
        ParameterError: ``margin`` is negative.
        DescriptionError: the hand has no pads.
    """

    def __init__(
        self,
        hand: HandDescription,
        obj: ObjectDescription,
        margin: float = 0.002,
        kinematics: Kinematics | None = None,
    ) -> None:
        if not margin >= 0:
            raise ParameterError("margin", margin, "at least 0 [m]")
        if not hand.pads:
            problem = "the hand has no [[pads]], so nothing of it can touch an object"
            raise DescriptionError(hand.transmission_path, problem)
        self.hand, self.obj, self.margin = hand, obj, margin
        self.kinematics = HandKinematics(hand) if kinematics is None else kinematics
        self._coal = require("coal")
        self._links = [hand.link_names.index(pad.link) for pad in hand.pads]
        self._pads = [Solid(self._coal, pad_shape(pad)) for pad in hand.pads]
        self._shapes = [Solid(self._coal, shape) for shape in obj.shapes]
        self._other_links = LinkShapes(self._coal, hand, LINK_MARGIN, self._coarse_distance)
        self._request = self._coal.DistanceRequest()
        self._result = self._coal.DistanceResult()

    def __call__(
        self,
        q: LinkPoses | Float[Tensor, " n_q"],
        position: Float[Tensor, " 3"],
        rotation: Float[Tensor, "3 3"],
        pressing: Collection[str] = (),
    ) -> ContactSet:
        """Contacts in the hand frame, in the order of ``hand.pads``; empty if nothing is near.

        Args:
            q: joint angles [rad] of one posture, or its link poses.
            position: object point o [m].
            rotation: object orientation R.
            pressing: pads that measure a force: they touch up to 6 mm off, by which pads and objects are
                described wrongly.

        Raises:
            ShapeError: not a single posture or pose.
            NonFiniteError: an entry is NaN or infinite.
        """
        frames, solids = self._placed(q, position, rotation)
        found, missed = self._of_pads(frames, solids, self.margin, pressing, measured=True)
        missed += self._other_links.touching(frames, solids)
        return self._contact_set(found, missed, position)

    def near(
        self,
        q: LinkPoses | Float[Tensor, " n_q"],
        position: Float[Tensor, " 3"],
        rotation: Float[Tensor, "3 3"],
        margin: float,
        pressing: Collection[str] = (),
    ) -> ContactSet:
        """The pads, then the links without a pad, whose gap is at most ``margin`` [m], of pads that press as
        in a call.

        A link's ``finger`` is the link's own name. Its friction is that of the object.

        Raises:
            ShapeError, NonFiniteError: as of a call.
        """
        frames, solids = self._placed(q, position, rotation)
        found, _ = self._of_pads(frames, solids, margin, pressing, measured=False)
        links = self._other_links.contacts(frames, solids, margin, CROWN_RADIUS)
        found += [(name, name, self.obj.torsional_friction, contact) for name, contact in links]
        return self._contact_set(found, [], position)

    def grown(self, distance: float) -> ContactDetector:
        """The same of an object whose surface is farther out by ``distance`` [m]."""
        made = copy.copy(self)
        made._shapes = [Solid(self._coal, shape.grown(distance)) for shape in self.obj.shapes]
        return made

    def _placed(
        self, q: LinkPoses | Tensor, position: Tensor, rotation: Tensor
    ) -> tuple[Array, list[tuple[Solid, Array]]]:
        """Poses of the links, and the object's primitives with theirs."""
        _check("position", position, (3,))
        _check("rotation", rotation, (3, 3))
        if isinstance(q, LinkPoses):
            poses = q
        else:
            _check("q", q, (self.hand.n_q,))
            with torch.no_grad():
                poses = self.kinematics(q.to(self.kinematics.dtype))
        if poses.transforms.dim() != 3:
            raise ShapeError("poses", "(n_link, 4, 4)", poses.transforms.shape, "one posture at a time")
        frames = poses.transforms.detach().to("cpu", torch.float64).numpy()
        T_object = np.eye(4)
        T_object[:3, :3] = rotation.detach().to("cpu", torch.float64).numpy()
        T_object[:3, 3] = position.detach().to("cpu", torch.float64).numpy()
        solids = [(solid, T_object @ solid.shape.transform) for solid in self._shapes]
        return frames, solids

    def _of_pads(
        self,
        frames: Array,
        solids: list[tuple[Solid, Array]],
        margin: float,
        pressing: Collection[str],
        *,
        measured: bool,
    ) -> tuple[list[Touch], list[NearMiss]]:
        """Pads within the margin, and the others; gaps only if ``measured``."""
        found, missed = [], []
        for pad, solid, link in zip(self.hand.pads, self._pads, self._links, strict=True):
            most = max(margin, PRESSING) if pad.name in pressing else margin
            contact = self._nearest(solid, frames[link], solids, most, measured)
            if isinstance(contact, PadContact):
                # the softer of the two surfaces makes the patch that resists spinning
                torsional = max(pad.torsional_friction, self.obj.torsional_friction)
                found.append((pad.name, pad.link, torsional, contact))
            else:
                missed.append(NearMiss(pad.link, pad.name, contact))
        return found, missed

    def _nearest(
        self, pad: Solid, T_link: Array, solids: list[tuple[Solid, Array]], margin: float, measured: bool
    ) -> PadContact | float:
        """The contact with the smallest gap over the object's primitives (the first one of equals), or else
        that gap."""
        T_pad = T_link @ pad.shape.transform
        best: PadContact | None = None
        least = math.inf
        for solid, T_solid in solids:
            if measured and math.isfinite(margin):
                coarse = self._coarse_distance(pad, T_pad, solid, T_solid)
                least = min(least, coarse)
                if coarse > margin:
                    continue
            contact = pad_contact(pad, T_pad, solid, T_solid, CROWN_RADIUS, margin)
            if contact is not None and (best is None or contact.gap < best.gap):
                best = contact
        return least if best is None else best

    def _coarse_distance(self, pad: Solid, T_pad: Array, solid: Solid, T_solid: Array) -> float:
        """coal's signed distance [m]: the gap without the crown, to its tolerance of 1e-6."""
        here, there = (self._coal.Transform3s(T[:3, :3], T[:3, 3]) for T in (T_pad, T_solid))
        self._result.clear()
        shapes = pad.geometry, here, solid.geometry, there
        return self._coal.distance(*shapes, self._request, self._result)

    def _contact_set(self, found: list[Touch], missed: list[NearMiss], position: Tensor) -> ContactSet:
        """In the precision of ``position``."""
        contacts = [contact for *_, contact in found]

        def tensor(values: list, *shape: int) -> Tensor:
            array = np.array(values, dtype=np.float64).reshape(len(found), *shape)
            return torch.from_numpy(array).to(position)

        return ContactSet(
            finger=tuple(finger for finger, *_ in found),
            link=tuple(link for _, link, *_ in found),
            point=tensor([c.point for c in contacts], 3),
            normal=tensor([c.normal for c in contacts], 3),
            gap=tensor([c.gap for c in contacts]),
            finger_curvature=tensor([c.finger_curvature for c in contacts], 3, 3),
            object_curvature=tensor([c.object_curvature for c in contacts], 3, 3),
            friction=tensor([self.obj.friction] * len(found)),
            torsional_friction=tensor([gamma for *_, gamma, _ in found]),
            pinned=tuple(c.pinned for c in contacts),
            near_misses=tuple(missed),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Made again from its arguments: coal's shapes can be neither copied nor pickled."""
        return ContactDetector, (self.hand, self.obj, self.margin, self.kinematics)

    def __repr__(self) -> str:
        return f"ContactDetector('{self.hand.name}', '{self.obj.name}', margin={self.margin})"


def _check(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    check_shape(name, value, shape, "one posture and one pose at a time")
    check_finite(name, value)
