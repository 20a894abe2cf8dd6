"""Signed distance to a primitive, with the surface's normal and curvature there.

A box, a ball and a capsule are all points within ``radius`` of a box, which may have no extent; a cylinder is
a box in the half plane (distance from the axis, height). The signed distance of a convex body is a convex
function of the point, inside and outside; the search in :mod:`torch_ekm.contact.detector` rests on that.

Twice, for speed: :func:`point_distance` in plain floats, faster for one point, and
:func:`signed_distance` in arrays, faster for many.
"""

from __future__ import annotations

from collections.abc import Callable
from math import copysign, hypot, sqrt

import numpy as np

from ..description import Shape
from ..typing import Array

Vec = tuple[float, float, float]
Distance = Callable[[float, float, float], tuple[float, Vec]]
"""Point [m] -> signed distance [m] and its gradient, the outward normal."""
# squares of less leave the range of a float, and a unit vector by them its length [m]
_NO_DIRECTION = 1e-150


def point_distance(shape: Shape) -> Distance:
    """``d(p) = min |p - x|`` over the surface, negative inside; the gradient has unit length.

    In the primitive's own frame (see :class:`torch_ekm.description.Shape`), one point at a time. On the
    medial axis any of the possible normals is given.
    """
    if shape.kind == "cylinder":
        return _cylinder(*shape.size)
    half, radius = _rounded_box(shape)
    return _box(*half, radius)


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
        p = (points - origin) @ rotation
        if shape.kind == "cylinder":
            rho = np.linalg.norm(p[..., :2], axis=-1)
            half = np.array([shape.size[0], shape.size[1] / 2])
            d, flat = _box_distances(np.stack([rho, p[..., 2]], axis=-1), half)
            on_axis = rho < 1e-12
            radial = p[..., :2] / np.where(on_axis, 1.0, rho)[..., None]
            radial[on_axis] = 1.0, 0.0
            n = np.concatenate([radial * flat[..., :1], flat[..., 1:]], axis=-1)
        else:
            half, radius = _rounded_box(shape)
            d, n = _box_distances(p, np.array(half))
            d = d - radius
        closer = d < distance
        distance = np.where(closer, d, distance)
        normal = np.where(closer[..., None], n @ rotation.T, normal)
    return distance, normal


def surface_curvature(shape: Shape, p: Vec, normal: Vec) -> tuple[list[tuple[float, Vec]], bool]:
    """Principal curvatures that are not zero, as ``(1/radius [1/m], unit direction)``, and "sharp".

    ``p`` is the point whose distance was asked, ``normal`` the gradient there. Sharp (an edge or a corner)
    means infinite curvature: no list is given.
    """
    x, y, z = p
    if shape.kind == "box":
        half = [extent / 2 for extent in shape.size]
        return [], sum(abs(v) > h for v, h in zip(p, half, strict=True)) > 1
    radius = shape.size[0]
    if shape.kind == "sphere":
        return [(1 / radius, direction) for direction in tangents(normal)], False
    half = shape.size[1] / 2
    if shape.kind == "capsule" and abs(z) > half:
        return [(1 / radius, direction) for direction in tangents(normal)], False
    if shape.kind == "cylinder":
        outside_cap, outside_side = abs(z) > half, hypot(x, y) > radius
        if outside_cap and outside_side:
            return [], True
        if abs(normal[2]) > 0.5:
            return [], False
    return [(1 / radius, (-normal[1], normal[0], 0.0))], False


def tangents(n: Vec) -> tuple[Vec, Vec]:
    """Two unit vectors that make a right-handed frame with the unit vector ``n``, without a branch at 0.

    Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    sign = copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


def _rounded_box(shape: Shape) -> tuple[Vec, float]:
    """Half extents of the box within a box, ball or capsule, and the radius around it [m]."""
    if shape.kind == "box":
        x, y, z = shape.size
        return (x / 2, y / 2, z / 2), 0.0
    return (0.0, 0.0, shape.size[1] / 2 if shape.kind == "capsule" else 0.0), shape.size[0]


def _box(hx: float, hy: float, hz: float, radius: float) -> Distance:
    def distance(x: float, y: float, z: float) -> tuple[float, Vec]:
        ex, ey, ez = abs(x) - hx, abs(y) - hy, abs(z) - hz
        ox, oy, oz = max(ex, 0.0), max(ey, 0.0), max(ez, 0.0)
        d = sqrt(ox * ox + oy * oy + oz * oz)
        if d > _NO_DIRECTION:
            return d - radius, (copysign(ox, x) / d, copysign(oy, y) / d, copysign(oz, z) / d)
        if ex >= ey and ex >= ez:
            return ex - radius, (copysign(1.0, x), 0.0, 0.0)
        if ey >= ez:
            return ey - radius, (0.0, copysign(1.0, y), 0.0)
        return ez - radius, (0.0, 0.0, copysign(1.0, z))

    return distance


def _cylinder(radius: float, length: float) -> Distance:
    half = length / 2

    def distance(x: float, y: float, z: float) -> tuple[float, Vec]:
        rho = hypot(x, y)
        er, ez = rho - radius, abs(z) - half
        # on the axis the radial direction is undefined: any will do
        ux, uy = (x / rho, y / rho) if rho > _NO_DIRECTION else (1.0, 0.0)
        if er <= 0 and ez <= 0:
            return (er, (ux, uy, 0.0)) if er >= ez else (ez, (0.0, 0.0, copysign(1.0, z)))
        orad, oz = max(er, 0.0), max(ez, 0.0)
        d = hypot(orad, oz)
        return d, (ux * orad / d, uy * orad / d, copysign(oz, z) / d)

    return distance


def _box_distances(p: Array, half: Array) -> tuple[Array, Array]:
    excess = np.abs(p) - half
    outside = np.maximum(excess, 0.0)
    reach = np.linalg.norm(outside, axis=-1)
    nearest_face = np.eye(p.shape[-1])[excess.argmax(axis=-1)]
    is_out = reach > _NO_DIRECTION
    direction = np.where(is_out[..., None], outside / np.maximum(reach, 1e-300)[..., None], nearest_face)
    return np.where(is_out, reach, excess.max(axis=-1)), direction * np.where(p < 0, -1.0, 1.0)
