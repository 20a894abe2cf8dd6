"""Contacts as exact functions of the state: the surfaces that touch, followed as hand and object move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torch_ekm.contact.contact_kinematics import FLAT, contact_frames
from torch_ekm.contact.contact_set import ContactSet
from torch_ekm.typing import Float, Tensor


@dataclass(frozen=True)
class Core:
    """A rounded body: all points within ``radius`` of a point, a line or a half space, in its own frame."""

    kind: str
    """"point", "line" or "plane"."""
    point: Float[Tensor, 3]
    direction: Float[Tensor, 3]
    """Of the line; outward normal of the plane; unused for a point."""
    radius: float


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
        poses = link_pose(q)
        self.finger: list[Core] = []
        self.object: list[Core] = []
        for i in range(contacts.n_c):
            x, n = contacts.point[i], contacts.normal[i]
            R_f, o_f = poses[i, :3, :3], poses[i, :3, 3]
            touch = x + contacts.gap[i] * n  # on the finger
            if contacts.pinned[i]:
                finger, obj = Core("point", touch, n, 0.0), Core("point", x, n, 0.0)
            else:
                finger = _core(contacts.finger_curvature[i], touch, -n)
                obj = _core(contacts.object_curvature[i], x, n)
                # a line contact has no contact point
                assert finger.kind == "point" or (finger.kind == "line" and obj.kind != "plane")
            self.finger.append(
                Core(finger.kind, R_f.mT @ (finger.point - o_f), R_f.mT @ finger.direction, finger.radius)
            )
            self.object.append(
                Core(obj.kind, rotation.mT @ (obj.point - position), rotation.mT @ obj.direction, obj.radius)
            )

    def __call__(
        self, q: Float[Tensor, " n_q"], position: Float[Tensor, 3], rotation: Float[Tensor, "3 3"]
    ) -> ContactSet:
        """The same contacts at another state."""
        poses = self.link_pose(q)
        points, normals, gaps, K_f, K_o = [], [], [], [], []
        for i, (finger, obj) in enumerate(zip(self.finger, self.object, strict=True)):
            R_f, o_f = poses[i, :3, :3], poses[i, :3, 3]
            p_f, d_f = o_f + R_f @ finger.point, R_f @ finger.direction
            p_o, d_o = position + rotation @ obj.point, rotation @ obj.direction
            if self.contacts.pinned[i]:
                # the finger's point carries the contact; the normal is fixed to the object
                points.append(p_f)
                normals.append(d_o)
                gaps.append(d_o @ (p_f - p_o))
                K_f.append(self.contacts.finger_curvature[i])
                K_o.append(self.contacts.object_curvature[i])
                continue
            at_f, at_o = _closest(finger.kind, p_f, d_f, obj.kind, p_o, d_o)
            if obj.kind == "plane":
                n = d_o
                distance = n @ (at_f - at_o)
            else:
                distance = torch.linalg.vector_norm(at_f - at_o)
                n = (at_f - at_o) / distance
            points.append(at_o + obj.radius * n)
            normals.append(n)
            gaps.append(distance - finger.radius - obj.radius)
            K_f.append(_curvature(finger, n, d_f))
            K_o.append(_curvature(obj, n, d_o))
        return self.contacts.replace(
            point=torch.stack(points),
            normal=torch.stack(normals),
            gap=torch.stack(gaps),
            finger_curvature=torch.stack(K_f),
            object_curvature=torch.stack(K_o),
        )

    def pinned_offset(self, q: Tensor, position: Tensor, rotation: Tensor) -> Float[Tensor, "n_c 3"]:
        """``x_f(q) - x_o(p)`` of pinned contacts' material points, object axes [m]; 0 for the others."""
        poses = self.link_pose(q)
        offset = torch.zeros_like(self.contacts.point)
        for i, (finger, obj) in enumerate(zip(self.finger, self.object, strict=True)):
            if self.contacts.pinned[i]:
                p_f = poses[i, :3, 3] + poses[i, :3, :3] @ finger.point
                offset[i] = rotation.mT @ (p_f - position) - obj.point
        return offset


def _core(K: Tensor, surface_point: Tensor, outward: Tensor) -> Core:
    """Ball, cylinder or plane with the given curvature tensor at a surface point."""
    tangent = contact_frames(outward[None])[0, :, 1:]
    k = tangent.mT @ K @ tangent
    values, vectors = torch.linalg.eigh(0.5 * (k + k.mT))
    low, high = values.tolist()
    assert low >= -FLAT
    flat_direction = tangent @ vectors[:, 0]
    if high <= FLAT:
        return Core("plane", surface_point, outward, 0.0)
    if low <= FLAT:
        return Core("line", surface_point - outward / high, flat_direction, 1 / high)
    assert high - low <= 1e-6 * high
    return Core("point", surface_point - outward / high, outward, 1 / high)


def _curvature(core: Core, normal: Tensor, direction: Tensor) -> Tensor:
    if core.kind == "plane":
        return normal.new_zeros(3, 3)
    eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
    K = eye - torch.outer(normal, normal)
    if core.kind == "line":
        K = K - torch.outer(direction, direction)
    return K / core.radius


def _closest(
    kind_f: str, p_f: Tensor, d_f: Tensor, kind_o: str, p_o: Tensor, d_o: Tensor
) -> tuple[Tensor, Tensor]:
    """Closest points of the finger's core (point or line) and the object's (point, line or plane)."""
    if kind_f == "point":
        if kind_o == "plane":
            return p_f, p_f - d_o * (d_o @ (p_f - p_o))
        return p_f, p_o if kind_o == "point" else p_o + d_o * (d_o @ (p_f - p_o))
    if kind_o == "point":
        return p_f + d_f * (d_f @ (p_o - p_f)), p_o
    w, b = p_f - p_o, d_f @ d_o
    denominator = 1 - b * b
    if float(denominator) < 1e-8:  # parallel cylinders touch along a line: keep the finger's own point
        return p_f, p_o + d_o * (d_o @ w)
    s = (b * (d_o @ w) - d_f @ w) / denominator
    t = ((d_o @ w) - b * (d_f @ w)) / denominator
    return p_f + s * d_f, p_o + t * d_o
