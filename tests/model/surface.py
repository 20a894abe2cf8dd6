"""Contacts as exact functions of the state: the surfaces that touch, followed as hand and object move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torch_ekm.contact.contacts import FLAT, ContactSet, contact_frames
from torch_ekm.typing import Float, Tensor


@dataclass(frozen=True)
class Core:
    """A rounded body: all points within ``radius`` of a point, a line or a plane."""

    point: Float[Tensor, " 3"]
    outward: Float[Tensor, " 3"]
    """Where it is touched at first: always so of a plane, and of a pinned contact."""
    directions: Float[Tensor, "3 k"]
    """That the line or the plane extends in; none of a point."""
    radius: float

    def moved(self, rotation: Tensor, position: Tensor) -> Core:
        point = position + rotation @ self.point
        return Core(point, rotation @ self.outward, rotation @ self.directions, self.radius)

    def curvature(self, normal: Tensor) -> Tensor:
        if self.radius == 0:
            return normal.new_zeros(3, 3)
        across = torch.eye(3, dtype=normal.dtype) - torch.outer(normal, normal)
        return (across - self.directions @ self.directions.mT) / self.radius


class TrackedContacts:
    """Follows each contact of a :class:`ContactSet` on the surfaces that its curvatures describe.

    A body whose curvature is isotropic is a ball there, one with a flat direction a cylinder, one
    without curvature a plane; for spheres, capsules, cylinders and boxes that is exact as long as the
    contact stays on the same feature. Contact points, normals and gaps are then smooth functions of the
    state, without the tolerance of a collision detector.

    ``contacts`` are those of one state, and ``link_pose(q)`` the poses of the links that carry them.
    """

    def __init__(
        self,
        contacts: ContactSet,
        link_pose: Callable[[Tensor], Tensor],
        q: Tensor,
        position: Tensor,
        rotation: Tensor,
    ) -> None:
        self.contacts, self.link_pose = contacts, link_pose
        self.finger: list[Core] = []
        self.object: list[Core] = []
        for i, pose in enumerate(link_pose(q)):
            x, n = contacts.point[i], contacts.normal[i]
            touch = x + contacts.gap[i] * n  # on the finger
            if contacts.pinned[i]:
                finger, obj = (Core(point, n, n.new_zeros(3, 0), 0.0) for point in (touch, x))
            else:
                finger = _core(contacts.finger_curvature[i], touch, -n)
                obj = _core(contacts.object_curvature[i], x, n)
                # a line contact has no contact point
                assert finger.directions.shape[1] + obj.directions.shape[1] <= 2
            R, o = pose[:3, :3].mT, pose[:3, 3]
            self.finger.append(finger.moved(R, -R @ o))
            self.object.append(obj.moved(rotation.mT, -rotation.mT @ position))

    def __call__(
        self, q: Float[Tensor, " n_q"], position: Float[Tensor, " 3"], rotation: Float[Tensor, "3 3"]
    ) -> ContactSet:
        """The same contacts at another state."""
        rows = []
        for i, pose in enumerate(self.link_pose(q)):
            finger, obj = (
                self.finger[i].moved(pose[:3, :3], pose[:3, 3]),
                self.object[i].moved(rotation, position),
            )
            if self.contacts.pinned[i]:
                # the finger's point carries the contact; the normal is fixed to the object
                curvatures = self.contacts.finger_curvature[i], self.contacts.object_curvature[i]
                rows.append(
                    (finger.point, obj.outward, obj.outward @ (finger.point - obj.point), *curvatures)
                )
                continue
            at_f, at_o = _closest(finger, obj)
            if obj.directions.shape[1] == 2:
                n = obj.outward
                distance = n @ (at_f - at_o)
            else:
                distance = torch.linalg.vector_norm(at_f - at_o)
                n = (at_f - at_o) / distance
            gap = distance - finger.radius - obj.radius
            rows.append((at_o + obj.radius * n, n, gap, finger.curvature(n), obj.curvature(n)))
        names = ("point", "normal", "gap", "finger_curvature", "object_curvature")
        parts = zip(names, zip(*rows, strict=True), strict=True)
        return self.contacts.replace(**{name: torch.stack(part) for name, part in parts})

    def pinned_offset(self, q: Tensor, position: Tensor, rotation: Tensor) -> Float[Tensor, "n_c 3"]:
        """``x_f(q) - x_o(p)`` of pinned contacts' material points, object axes [m]; 0 for the others."""
        offset = torch.zeros_like(self.contacts.point)
        for i, pose in enumerate(self.link_pose(q)):
            if self.contacts.pinned[i]:
                finger = self.finger[i].moved(pose[:3, :3], pose[:3, 3])
                offset[i] = rotation.mT @ (finger.point - position) - self.object[i].point
        return offset


def _core(K: Tensor, surface_point: Tensor, outward: Tensor) -> Core:
    """Ball, cylinder or plane with the given curvature tensor at a surface point."""
    tangent = contact_frames(outward[None])[0, :, 1:]
    values, vectors = torch.linalg.eigh(tangent.mT @ K @ tangent)
    curved = values[values > FLAT]
    assert float(values.min()) >= -FLAT
    assert len(curved) < 2 or float(curved[1] - curved[0]) <= 1e-6 * float(curved[1])
    radius = 1 / float(curved[0]) if len(curved) else 0.0
    return Core(surface_point - radius * outward, outward, tangent @ vectors[:, values <= FLAT], radius)


def _closest(finger: Core, obj: Core) -> tuple[Tensor, Tensor]:
    """Closest points of two cores."""
    k = finger.directions.shape[1]
    both = torch.cat([finger.directions, -obj.directions], dim=1)
    along = torch.linalg.pinv(both) @ (obj.point - finger.point)
    return finger.point + finger.directions @ along[:k], obj.point + obj.directions @ along[k:]
