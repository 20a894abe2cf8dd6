"""Signed distance and outward normal of primitive solids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...description.shape import Shape

Array = NDArray[np.float64]


def signed_distance(shapes: tuple[Shape, ...], points: Array) -> tuple[Array, Array]:
    """Distance of each point to the union of the solids, and the unit gradient there.

    Args:
        shapes: the solids.
        points: in their common frame ``(*batch, 3)`` [m].

    Returns:
        ``(*batch)`` [m], negative inside, and ``(*batch, 3)``. On the medial axis any of the
        possible normals is given.
    """
    distance = np.full(points.shape[:-1], np.inf)
    normal = np.zeros_like(points)
    for shape in shapes:
        rotation, origin = shape.transform[:3, :3], shape.transform[:3, 3]
        d, n = _one(shape, (points - origin) @ rotation)
        closer = d < distance
        distance = np.where(closer, d, distance)
        normal = np.where(closer[..., None], n @ rotation.T, normal)
    return distance, normal


def scaled(shape: Shape, factor: float) -> Shape:
    """The shape with all lengths, its distance from the origin included, times ``factor``."""
    transform = shape.transform.copy()
    transform[:3, 3] *= factor
    return Shape(shape.kind, tuple(factor * size for size in shape.size), transform)


def _one(shape: Shape, p: Array) -> tuple[Array, Array]:
    if shape.kind == "box":
        return _box(p, np.array(shape.size) / 2)
    if shape.kind == "sphere":
        return _ball(p, shape.size[0])
    radius, length = shape.size
    if shape.kind == "capsule":
        axis_point = np.zeros_like(p)
        axis_point[..., 2] = np.clip(p[..., 2], -length / 2, length / 2)
        return _ball(p - axis_point, radius)
    # A cylinder is a box in the half plane (distance from the axis, height).
    rho = np.linalg.norm(p[..., :2], axis=-1)
    flat = np.stack([rho, p[..., 2]], axis=-1)
    d, n = _box(flat, np.array([radius, length / 2]))
    radial = p[..., :2] / np.maximum(rho, 1e-12)[..., None]
    return d, np.concatenate([radial * n[..., :1], n[..., 1:]], axis=-1)


def _ball(p: Array, radius: float) -> tuple[Array, Array]:
    length = np.linalg.norm(p, axis=-1)
    return length - radius, p / np.maximum(length, 1e-12)[..., None]


def _box(p: Array, half: Array) -> tuple[Array, Array]:
    excess = np.abs(p) - half
    outside = np.maximum(excess, 0.0)
    reach = np.linalg.norm(outside, axis=-1)
    depth = excess.max(axis=-1)
    nearest_face = np.eye(p.shape[-1])[excess.argmax(axis=-1)]
    is_out = reach > 0
    direction = np.where(is_out[..., None], outside / np.maximum(reach, 1e-300)[..., None], nearest_face)
    return np.where(is_out, reach, depth), direction * np.where(p < 0, -1.0, 1.0)
