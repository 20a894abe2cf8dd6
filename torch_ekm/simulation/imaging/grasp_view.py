"""A hand that holds an object, as a camera sees it."""

from __future__ import annotations

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...exceptions import ParameterError
from ...kinematics import GraspState, HandKinematics
from ...sensing.vision.board import MarkerBoard
from ...typing import Array
from .card_scene import CardScene, ConvexBody, PlacedCard

_DISTANCE = 0.40  # [m] of the camera from the middle between the boards


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
