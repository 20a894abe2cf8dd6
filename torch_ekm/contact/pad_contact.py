"""Contacts of fingertip pads, and of links without a pad, with the primitives of an object, in closed form.

A box, a ball and a capsule are all points within ``radius`` of a box, which may have no extent; a cylinder is
a box in the half plane (distance from the axis, height). The signed distance of a convex body is a convex
function of the point, inside and outside; the search along a pad rests on that. It is here twice, for speed:
:func:`point_distance` in plain floats, faster for one point, and :func:`signed_distance` in arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import copysign, hypot, sqrt
from typing import Any, NamedTuple

import numpy as np

from ..description import ContactPad, HandDescription, Shape
from ..typing import Array
from .contacts import NearMiss

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


_EYE = np.eye(3)


class Solid:
    """A primitive of a link or an object, for coal and for the closed form."""

    def __init__(self, coal: Any, shape: Shape) -> None:
        make = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere, "capsule": coal.Capsule}
        self.shape = shape
        self.geometry = make[shape.kind](*shape.size)
        self.distance = point_distance(shape)
        self.round = shape.kind in ("capsule", "sphere")
        self.radius, self.half = shape.size[0], shape.size[1] / 2 if shape.kind == "capsule" else 0.0


def pad_shape(pad: ContactPad) -> Shape:
    """A pad in its link's frame, its axis along z."""
    start, end = np.array(pad.start), np.array(pad.end)
    length, transform = float(np.linalg.norm(end - start)), np.eye(4)
    transform[:3, 3] = (start + end) / 2
    if length == 0:
        return Shape("sphere", (pad.radius,), transform)
    axis = (end - start) / length
    transform[:3, :3] = np.stack([*tangents(tuple(axis.tolist())), axis], axis=-1)
    return Shape("capsule", (pad.radius, length), transform)


class PadContact(NamedTuple):
    """One contact of a pad, hand frame."""

    point: Array
    normal: Array
    gap: float
    finger_curvature: Array
    object_curvature: Array
    pinned: bool


def flat_contact(coal, link: Solid, T_link: Array, solid: Solid, T_solid: Array) -> PadContact:
    """The contact of a link's box or cylinder with one primitive, by coal's nearest points.

    The link counts as flat there; where the object is flat, too, nothing rolls.
    """
    result = coal.DistanceResult()
    here, there = (coal.Transform3s(T[:3, :3], T[:3, 3]) for T in (T_link, T_solid))
    gap = coal.distance(link.geometry, here, solid.geometry, there, coal.DistanceRequest(), result)
    points = result.getNearestPoint1().ravel(), result.getNearestPoint2().ravel()
    point = 0.5 * (points[0] + points[1])
    n = -np.asarray(result.normal).ravel()  # from the object to the link
    local = T_solid[:3, :3].T @ (points[1] - T_solid[:3, 3])
    inner = T_solid[:3, :3].T @ n
    principal, sharp = surface_curvature(solid.shape, tuple(local.tolist()), tuple(inner.tolist()))
    K_o = _curvature(principal, T_solid[:3, :3])
    return PadContact(point, n, gap, np.zeros((3, 3)), K_o, sharp or not principal)


def _curvature(principal: list, rotation: Array) -> Array:
    """Of the object, from its principal curvatures in its own axes."""
    K = np.zeros((3, 3))
    for curvature, direction in principal:
        e = rotation @ direction
        K += curvature * e[:, None] * e
    return K


def pad_contact(
    pad: Solid, T_pad: Array, solid: Solid, T_solid: Array, R: float, margin: float
) -> PadContact | None:
    """The contact of a pad with one primitive; the equations are those of ``ContactDetector``.

    Args:
        T_pad, T_solid: poses in the hand frame, ``(4, 4)``.
        R: crown radius of the pad [m]; infinite: no crown.
        margin: None where the gap is above it [m].
    """
    rotation = T_solid[:3, :3]
    m = tuple((rotation.T @ (T_pad[:3, 3] - T_solid[:3, 3])).tolist())
    t = tuple((rotation.T @ T_pad[:3, 2]).tolist())
    s = crown = 0.0
    if pad.half > 0:
        d, n = solid.distance(*m)  # d is convex: no point of the axis is nearer than its tangent plane says
        if d - pad.half * abs(n[0] * t[0] + n[1] * t[1] + n[2] * t[2]) - pad.radius > margin:
            return None
        s, crown = _along(solid, m, t, pad.half, 1 / R)
    c = (m[0] + s * t[0], m[1] + s * t[1], m[2] + s * t[2])
    d, n_local = solid.distance(*c)
    gap = d - pad.radius
    if gap > margin:
        return None
    principal, sharp = surface_curvature(solid.shape, c, n_local)

    n = rotation @ n_local
    K_o = _curvature(principal, rotation)
    K_f = (_EYE - n[:, None] * n) / pad.radius
    lean = float(n @ T_pad[:3, 2])
    # On the side: the crown instead of 1/rho along the axis. There |lean| <= half crown, except deep inside a
    # body on a ridge of d, where no side is touched.
    if abs(s) < pad.half and abs(lean) < 2 * pad.half * crown + 1e-6:
        e = T_pad[:3, 2] - n * lean
        e /= sqrt(e @ e)
        K_f += (crown - 1 / pad.radius) * e[:, None] * e
    point = T_pad[:3, 3] + s * T_pad[:3, 2] - (pad.radius + gap / 2) * n
    return PadContact(point, n, gap, K_f, K_o, sharp)


def _along(solid: Solid, m: tuple, t: tuple, half: float, most: float) -> tuple[float, float]:
    """Where the side touches, and the crown there [1/m]: what a flat object lacks to ``most``.

    A body curved along the pad has a contact point of its own, from which a crown would lead away: the
    curvature ``d2/ds2 d(m + s t)`` that it has is taken off the crown's.
    """
    s = _closest(solid, m, t, half, most)
    if abs(s) >= half:  # at a round end, crown or not
        return s, most

    step = 1e-6
    (_, _, behind), (c, n, here), (_, _, ahead) = (_at(solid, m, t, x) for x in (s - step, s, s + step))
    if surface_curvature(solid.shape, c, n)[1]:
        return s, most  # without crown a pad along the face beyond the edge would jump to its end
    curved = min(here - behind, ahead - here) / step  # the face's, where s is within a step of its edge
    crown = min(most, max(0.0, most - curved))
    return (_closest(solid, m, t, half, crown) if crown < most else s), crown


def _at(solid: Solid, m: tuple, t: tuple, s: float) -> tuple[Vec, Vec, float]:
    """The point ``m + s t``, n there, and ``n . t``: the slope of d along the pad."""
    c = (m[0] + s * t[0], m[1] + s * t[1], m[2] + s * t[2])
    n = solid.distance(*c)[1]
    return c, n, n[0] * t[0] + n[1] * t[1] + n[2] * t[2]


def _closest(solid: Solid, m: tuple, t: tuple, half: float, epsilon: float) -> float:
    """``argmin d(m + s t) + epsilon s^2/2`` over ``|s| <= half``: the zero of an increasing function.

    Its slope is at least ``epsilon``, so a value below 1e-12 leaves less than ``1e-12/epsilon`` [m]. Without
    crown a line of contact has no such zero: its middle is taken.
    Regula falsi (Illinois) with a bisection every third step, for the steps that the function has at the
    edges and inside of a body.
    """

    def slope(s: float) -> float:
        return _at(solid, m, t, s)[2] + epsilon * s

    a, b = -half, half
    fa, fb = slope(a), slope(b)
    if epsilon == 0 and max(abs(fa), abs(fb)) < 1e-12:
        return 0.0
    if fa >= 0:
        return a
    if fb <= 0:
        return b
    moved = ""
    for k in range(120):
        s = a + (b - a) / 2 if k % 3 == 2 else a - fa * (b - a) / (fb - fa)
        fs = slope(s)
        if abs(fs) < 1e-12 or b - a < 1e-13:
            return s
        if fs > 0:
            b, fb, fa = s, fs, fa / 2 if moved == "b" else fa
            moved = "b"
        else:
            a, fa, fb = s, fs, fb / 2 if moved == "a" else fb
            moved = "a"
    return a + (b - a) / 2


class LinkShapes:
    """The collision shapes of all links without a pad, each in a bounding ball.

    A link is far where ``d(c) > r + margin``, c and r centre and radius of the ball and d the signed
    distance to the object; only what is near is given to coal.

    Args:
        margin: largest gap at which a link touches [m].
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
        self._links = [index for index, *_ in self._shapes]
        self._centres = np.array([[*solid.shape.transform[:3, 3], 1.0] for _, _, solid in self._shapes])

    def touching(self, frames: Array, solids: list[tuple[Solid, Array]]) -> list[NearMiss]:
        """The links that touch, one entry for each.

        Args:
            frames: poses of all links ``(n_link, 4, 4)``.
            solids: the object's primitives with their poses.
        """
        found: dict[str, float] = {}
        for link, shape, T_link, solid, T in self._near(frames, solids, self.margin):
            gap = self._distance(shape, T_link, solid, T)
            if gap <= min(self.margin, found.get(link, self.margin)):
                found[link] = gap
        return [NearMiss(link, None, gap) for link, gap in found.items()]

    def contacts(
        self, frames: Array, solids: list[tuple[Solid, Array]], margin: float, crown_radius: float
    ) -> list[tuple[str, PadContact]]:
        """Links within ``margin`` [m] of the object, each with the contact of its smallest gap, in the order
        of the hand's links; arguments as of :meth:`touching` and :func:`pad_contact`."""
        found: dict[str, PadContact] = {}
        for link, shape, T_link, solid, T in self._near(frames, solids, margin):
            if shape.round:
                one = pad_contact(shape, T_link, solid, T, crown_radius, margin)
            else:
                one = flat_contact(self._coal, shape, T_link, solid, T)
            if one is not None and one.gap <= margin and (link not in found or one.gap < found[link].gap):
                found[link] = one
        names = dict.fromkeys(name for _, name, _ in self._shapes)
        return [(link, found[link]) for link in names if link in found]

    def _near(
        self, frames: Array, solids: list[tuple[Solid, Array]], margin: float
    ) -> Iterator[tuple[str, Solid, Array, Solid, Array]]:
        """Shapes whose balls are within ``margin`` of a primitive of the object, both with their poses."""
        if not self._shapes:
            return
        centres = (frames[self._links] @ self._centres[:, :, None])[:, :3, 0]
        for solid, T in solids:
            near = (centres - T[:3, 3]) @ T[:3, :3]
            for (index, link, shape), centre in zip(self._shapes, near.tolist(), strict=True):
                if solid.distance(*centre)[0] <= shape.geometry.aabb_radius + margin:
                    yield link, shape, frames[index] @ shape.shape.transform, solid, T
