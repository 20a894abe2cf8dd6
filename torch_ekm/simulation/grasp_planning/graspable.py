"""Facts about the shape of hands and objects that a grasp planner needs."""

from __future__ import annotations

import numpy as np

from ...description import ContactPad, HandDescription, ObjectDescription
from ...typing import Array


def obstacles(hand: HandDescription, pads: tuple[ContactPad, ...]) -> tuple[list[str], Array, Array]:
    """Balls that stand for the solid parts of the hand, the pads' rounded ends left out.

    Returns the link of each ball, its centre in that link ``(n, 3)`` [m] and its radius ``(n,)`` [m].
    """
    balls: list[tuple[str, Array, float]] = []
    carrying = {pad.link: pad for pad in pads}
    for link in hand.urdf.links:
        if link.name in carrying:
            balls.append((link.name, np.array(carrying[link.name].start), carrying[link.name].radius))
            continue
        for shape in link.collisions:
            rotation, origin = shape.transform[:3, :3], shape.transform[:3, 3]
            if shape.kind == "box":
                half = np.array(shape.size) / 2
                for corner in np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * 3), axis=-1).reshape(-1, 3):
                    if np.abs(corner).max() == 1:
                        balls.append((link.name, origin + rotation @ (half * corner), 0.0))
            elif shape.kind == "sphere":
                balls.append((link.name, origin, shape.size[0]))
            else:
                for part in (-0.5, 0.0, 0.5):
                    balls.append((link.name, origin + part * shape.size[1] * rotation[:, 2], shape.size[0]))
    links, centres, radii = zip(*balls, strict=True)
    return list(links), np.array(centres), np.array(radii)


def object_axes(obj: ObjectDescription) -> Array:
    """Columns: the longest direction across the grasp axis, the grasp axis, and their product."""
    grasp = obj.grasp_axis / np.linalg.norm(obj.grasp_axis)
    helper = np.eye(3)[np.argmin(np.abs(grasp))]
    first = np.cross(helper, grasp)
    first /= np.linalg.norm(first)
    long_axis = max(np.cross(grasp, first), first, key=lambda axis: half_extent(obj, axis))
    return np.asarray(np.stack([long_axis, grasp, np.cross(long_axis, grasp)], axis=1), dtype=np.float64)


def half_extent(obj: ObjectDescription, axis: Array) -> float:
    """How far the object reaches from its origin along a unit vector, in its frame [m]."""
    found = 0.0
    for shape in obj.shapes:
        local, centre = np.abs(shape.transform[:3, :3].T @ axis), abs(float(shape.transform[:3, 3] @ axis))
        radius, length = (*shape.size, 0.0)[:2]
        if shape.kind == "box":
            found = max(found, centre + float(local @ np.array(shape.size)) / 2)
        else:
            found = max(found, centre + float(local[2]) * length / 2 + radius)
    return found


def opposition(tips: Array, directions: Array) -> tuple[Array, Array]:
    """How well the first pad and the others face each other, cosines ``(b, c)``, and their distance ``(b,)``.

    Args:
        tips: centres of the pads' rounded ends ``(b, c, 3)`` [m].
        directions: outward directions of their middles ``(b, c, 3)``.
    """
    across = tips[:, 1:].mean(axis=1) - tips[:, 0]
    distance = np.linalg.norm(across, axis=1)
    across /= distance[:, None]
    facing = np.einsum("bci,bi->bc", directions, across)
    facing[:, 1:] *= -1.0
    return facing, distance
