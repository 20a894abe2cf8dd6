"""A hand that holds an object, as a camera sees it."""

from __future__ import annotations

import numpy as np
import torch

from ...description import HandDescription, ObjectDescription
from ...exceptions import ParameterError
from ...kinematics import HandKinematics
from ...sensing.vision.board import MarkerBoard
from ...typing import Array, Float, Tensor
from .card_scene import CardScene, ConvexBody, PlacedCard

_DISTANCE = 0.40  # [m] of the camera from the middle between the boards


class GraspView:
    """``T_camera,card = T_hand,camera^-1 T_hand,body T_body,card``, and the same for every shape.

    Turns a state of hand and object into a :class:`CardScene`: both marker boards, the links of the hand and
    the object's shapes, all of which may hide a marker.

    Args:
        hand: its URDF gives the shapes of the links.
        obj: the object.
        palm_board: on the base link, at its ``mount`` in the hand frame.
        object_board: on the object, at its ``mount`` in the object's frame.
        camera_pose: pose of the camera in the hand frame, ``(4, 4)``; see :meth:`facing`.
    """

    def __init__(
        self,
        hand: HandDescription,
        obj: ObjectDescription,
        palm_board: MarkerBoard,
        object_board: MarkerBoard,
        camera_pose: Array,
    ) -> None:
        self.palm_board, self.object_board = palm_board, object_board
        self.camera_pose = camera_pose
        self._kinematics = HandKinematics(hand)
        self._links = [
            (self._kinematics.link_index(link.name), ConvexBody.of_shape(shape))
            for link in hand.urdf.links
            for shape in link.collisions
        ]
        self._object = [ConvexBody.of_shape(shape, shade=150) for shape in obj.shapes]

    def scene(
        self, q: Float[Tensor, " n_q"], position: Float[Tensor, " 3"], rotation: Float[Tensor, "3 3"]
    ) -> CardScene:
        """The scene in the camera frame, at joint angles ``q`` [rad] and an object pose in the hand frame."""
        to_camera = np.linalg.inv(self.camera_pose)
        with torch.no_grad():
            links = self._kinematics(q.detach().to(torch.float64)).transforms.numpy()
        body_of_object = np.eye(4)
        body_of_object[:3, :3], body_of_object[:3, 3] = rotation.detach(), position.detach()
        bodies = [body.moved(to_camera @ links[k]) for k, body in self._links]
        bodies += [body.moved(to_camera @ body_of_object) for body in self._object]
        cards = (
            PlacedCard(self.palm_board, to_camera @ self.palm_board.mount),
            PlacedCard(self.object_board, to_camera @ body_of_object @ self.object_board.mount),
        )
        return CardScene(cards, tuple(bodies))

    @staticmethod
    def facing(palm: Array, obj: Array) -> Array:
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
