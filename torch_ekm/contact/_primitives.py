"""Signed distance from a point to a primitive, with the surface's normal and curvature there.

Everything in the primitive's own frame (see :class:`torch_ekm.description.Shape`), in plain floats: one
point at a time, a few microseconds each. The signed distance of a convex body is a convex function of the
point, inside and outside; the search in :mod:`torch_ekm.contact.detector` rests on that.
"""

from __future__ import annotations

from collections.abc import Callable
from math import copysign, hypot, sqrt

from ..description import Shape

Vec = tuple[float, float, float]
Distance = Callable[[float, float, float], tuple[float, Vec]]
"""Point [m] -> signed distance [m] and its gradient, the outward normal."""


def signed_distance(shape: Shape) -> Distance:
    """``d(p) = min |p - x|`` over the surface, negative inside; the gradient has unit length."""
    return _DISTANCES[shape.kind](*shape.size)


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


def _box(size_x: float, size_y: float, size_z: float) -> Distance:
    hx, hy, hz = size_x / 2, size_y / 2, size_z / 2

    def distance(x: float, y: float, z: float) -> tuple[float, Vec]:
        ex, ey, ez = abs(x) - hx, abs(y) - hy, abs(z) - hz
        if ex <= 0 and ey <= 0 and ez <= 0:
            if ex >= ey and ex >= ez:
                return ex, (copysign(1.0, x), 0.0, 0.0)
            if ey >= ez:
                return ey, (0.0, copysign(1.0, y), 0.0)
            return ez, (0.0, 0.0, copysign(1.0, z))
        ox, oy, oz = max(ex, 0.0), max(ey, 0.0), max(ez, 0.0)
        d = sqrt(ox * ox + oy * oy + oz * oz)
        return d, (copysign(ox, x) / d, copysign(oy, y) / d, copysign(oz, z) / d)

    return distance


def _cylinder(radius: float, length: float) -> Distance:
    half = length / 2

    def distance(x: float, y: float, z: float) -> tuple[float, Vec]:
        rho = hypot(x, y)
        er, ez = rho - radius, abs(z) - half
        # on the axis the radial direction is undefined: any will do
        ux, uy = (x / rho, y / rho) if rho > 0 else (1.0, 0.0)
        if er <= 0 and ez <= 0:
            return (er, (ux, uy, 0.0)) if er >= ez else (ez, (0.0, 0.0, copysign(1.0, z)))
        orad, oz = max(er, 0.0), max(ez, 0.0)
        d = hypot(orad, oz)
        return d, (ux * orad / d, uy * orad / d, copysign(oz, z) / d)

    return distance


def _capsule(radius: float, length: float) -> Distance:
    half = length / 2

    def distance(x: float, y: float, z: float) -> tuple[float, Vec]:
        dz = z - max(-half, min(half, z))
        d = sqrt(x * x + y * y + dz * dz)
        return (d - radius, (x / d, y / d, dz / d)) if d > 0 else (-radius, (1.0, 0.0, 0.0))

    return distance


_DISTANCES: dict[str, Callable[..., Distance]] = {
    "box": _box,
    "cylinder": _cylinder,
    "capsule": _capsule,
    "sphere": lambda radius: _capsule(radius, 0.0),
}
