"""What stands before the camera: cards with markers, and bodies that hide them, as a hand and its object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..._extras import require
from ...description import HandDescription, ObjectDescription, Shape
from ...exceptions import ParameterError
from ...kinematics import GraspState, HandKinematics
from ...sensing.camera import MarkerBoard, PinholeCamera
from ...typing import Array

_SIDES = 32  # of the prism that stands for a cylinder
_PER_BALL = 24  # points of the outline of a ball
_DISTANCE = 0.40  # [m] of the camera from the middle between the boards


@dataclass(frozen=True, eq=False)
class ConvexBody:
    """The convex hull of ``n`` balls: a capsule is two, a box eight of radius 0."""

    centres: Array
    """``(n, 3)`` [m]"""
    radii: Array
    """``(n,)`` [m]"""
    shade: int = 90
    """Grey level, 0 black to 255 white."""

    @classmethod
    def of_shape(cls, shape: Shape, shade: int = 90) -> ConvexBody:
        """A primitive of a hand's or object's description, in the frame of its link or object."""
        radius, length = (*shape.size, 0.0)[:2]
        if shape.kind == "box":
            signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
            body = cls(signs * np.asarray(shape.size), np.zeros(8), shade)
        elif shape.kind == "cylinder":
            angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
            ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            ends = [np.c_[ring, np.full(_SIDES, z)] for z in (-length / 2, length / 2)]
            body = cls(np.concatenate(ends), np.zeros(2 * _SIDES), shade)
        else:
            end = np.array([0, 0, length / 2])
            body = cls(np.stack([-end, end]), np.full(2, radius), shade)
        return body.moved(shape.transform)

    def moved(self, transform: Array) -> ConvexBody:
        """The body seen from another frame: ``x -> R x + t``."""
        return ConvexBody(self.centres @ transform[:3, :3].T + transform[:3, 3], self.radii, self.shade)

    def outline(self, camera: PinholeCamera) -> Array | None:
        """Convex outline in the image, ``(m, 2)`` [px], counter-clockwise for u to the right, v up.

        None where the body is not before the camera.

        A ball of centre c and radius r shows its circle about ``c (1 - r^2/d^2)`` of radius
        ``r sqrt(1 - r^2/d^2)``, normal to c, with ``d = |c|``; and the picture of a convex hull
        is the convex hull of the pictures.
        """
        distance = np.linalg.norm(self.centres, axis=1)
        if np.any(self.centres[:, 2] - self.radii <= 1e-3):
            return None
        points = self.centres[:, None, :]
        if np.any(self.radii > 0):
            shrink = 1 - (self.radii / distance) ** 2
            axis = self.centres / distance[:, None]
            first = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0]))
            first /= np.linalg.norm(first, axis=1, keepdims=True)
            second = np.cross(axis, first)
            angle = 2 * np.pi * np.arange(_PER_BALL) / _PER_BALL
            circle = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
            radius = self.radii * np.sqrt(shrink) / np.cos(np.pi / _PER_BALL)  # the polygon circumscribes
            points = self.centres[:, None] * shrink[:, None, None] + radius[:, None, None] * circle
        pixels = camera.project(points.reshape(-1, 3))
        # found in float32, good to 1e-4 px in a picture of 640 px; returned as they were
        corners = require("cv2").convexHull(pixels.astype(np.float32), returnPoints=False)
        return pixels[corners.ravel()]


@dataclass(frozen=True, eq=False)
class PlacedCard:
    """A card and its pose in the camera frame, ``(4, 4)``."""

    card: MarkerBoard
    pose: Array

    @property
    def outline(self) -> Array:
        """The four corners in the camera frame, ``(4, 3)`` [m], upper left first, clockwise."""
        w, h = self.card.size
        flat = np.array([[-w, h, 0], [w, h, 0], [w, -h, 0], [-w, -h, 0]]) / 2
        return flat @ self.pose[:3, :3].T + self.pose[:3, 3]

    def hidden_by(self, body: ConvexBody) -> bool:
        """True where the body lies on the camera's side of the card's plane.

        Bodies do not cut through cards; of one that crosses the plane away from the card, the part next to
        the card decides.
        """
        normal, origin = self.pose[:3, 2], self.pose[:3, 3]
        nearest = body.centres[np.argmin(np.linalg.norm(body.centres - origin, axis=1))]
        return bool((nearest - origin) @ normal * (-origin @ normal) > 0)


@dataclass(frozen=True)
class CardScene:
    """Cards and bodies in the camera frame."""

    cards: tuple[PlacedCard, ...] = ()
    bodies: tuple[ConvexBody, ...] = ()

    def obstructed(self, card: int) -> CardScene:
        """The scene with a ball half way between the camera and a card, which hides all of it."""
        outline = self.cards[card].outline / 2
        centre = outline.mean(axis=0)
        radius = 1.2 * np.linalg.norm(outline - centre, axis=1).max()
        return replace(self, bodies=(*self.bodies, ConvexBody(centre[None], np.array([radius]), shade=70)))


def grasp_scene(
    hand: HandDescription,
    obj: ObjectDescription,
    boards: tuple[MarkerBoard, MarkerBoard],
    camera_pose: Array,
    state: GraspState,
) -> CardScene:
    """``T_camera,card = T_hand,camera^-1 T_hand,body T_body,card``, and the same for every shape.

    Both marker boards, the links of the hand and the object's shapes, all of which may hide a marker, in the
    camera frame.

    Args:
        hand: its URDF gives the shapes of the links.
        obj: the object.
        boards: on the base link, and on the object, each at its ``mount`` in the frame of that.
        camera_pose: pose of the camera in the hand frame, ``(4, 4)``; see :func:`camera_facing`.
        state: joint angles, and the object's pose in the hand frame.
    """
    to_camera, body_of_object = np.linalg.inv(camera_pose), np.eye(4)
    body_of_object[:3, :3], body_of_object[:3, 3] = state.rotation.detach(), state.position.detach()
    links = HandKinematics(hand)(state.q.detach().double())
    bodies = [
        ConvexBody.of_shape(shape).moved(to_camera @ links.of(link.name).numpy())
        for link in hand.urdf.links
        for shape in link.collisions
    ]
    of_object = to_camera @ body_of_object
    bodies += [ConvexBody.of_shape(shape, shade=150).moved(of_object) for shape in obj.shapes]
    placed = zip(boards, (to_camera, of_object), strict=True)
    return CardScene(tuple(PlacedCard(board, T @ board.mount) for board, T in placed), tuple(bodies))


def camera_facing(palm: Array, obj: Array) -> Array:
    """A camera pose from which two cards are seen equally askew.

    The camera looks at the point between the cards, from the direction half way between their
    normals; its image is turned so that the line from palm to object is horizontal.

    Args:
        palm, obj: poses of the cards in the hand frame, ``(4, 4)``.

    Raises:
        ParameterError: the cards face away from each other, or one hides in line with the other.
    """
    direction = palm[:3, 2] + obj[:3, 2]
    length = np.linalg.norm(direction)
    if length < 0.2:
        valid = "a card whose normal is within 160 deg of the palm's"
        raise ParameterError("obj", obj[:3, 2].tolist(), valid)
    forward = -direction / length
    right = obj[:3, 3] - palm[:3, 3]
    right = right - (right @ forward) * forward
    if np.linalg.norm(right) < 1e-3:
        raise ParameterError("obj", obj[:3, 3].tolist(), "to the side of the palm's card in the image")
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = (palm[:3, 3] + obj[:3, 3]) / 2 - _DISTANCE * forward
    return pose
