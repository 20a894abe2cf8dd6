from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import torch
from numpy.typing import NDArray

from ..._extras import require
from ...exceptions import ObjectLostError, ParameterError, ShapeError
from ...kinematics.poses import hat
from ...typing import Array, Float, Tensor
from .board import MarkerBoard, get_dictionary
from .board_pose import BoardPose, angle_between, estimate_board_pose
from .camera import PinholeCamera

_MAX_STEP, _MAX_TURN = 0.020, float(np.radians(20.0))  # believable between two frames [m], [rad]
_MIN_MARKERS = 2  # of a board that must be seen: one alone is prone to flips
_JUMP_FRAMES = 3  # a jump is accepted when that many frames in a row agree on it


class TrackStatus(Enum):
    """Why there is a pose, or none."""

    OK = "ok"
    NO_IMAGE = "no_image"  # the frame was dropped
    PALM_HIDDEN = "palm_hidden"  # too few markers of the palm's board were found
    OBJECT_HIDDEN = "object_hidden"  # too few markers of the object's board were found
    AMBIGUOUS = "ambiguous"  # two mirrored poses fit, and no earlier frame decides which
    JUMP = "jump"  # the pose is too far from the last one; accepted when seen repeatedly


@dataclass(frozen=True)
class Track:
    """Pose of the object in the hand frame, or the reason why there is none.

    ``position``, ``rotation`` and ``covariance`` are None unless ``status`` is OK.
    """

    status: TrackStatus
    position: Float[Tensor, " 3"] | None = None
    """Origin of the object's frame [m], float64."""
    rotation: Float[Tensor, "3 3"] | None = None
    covariance: Float[Tensor, "6 6"] | None = None
    """Of the error twist ``(v; w)`` about the object's origin, hand axes [m, rad]."""
    palm: BoardPose | None = None
    """The palm's board in the camera frame, where it was found in this image."""
    object: BoardPose | None = None
    """The object's board in the camera frame, where it was found."""
    markers: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    """Corners ``(4, 2)`` [px] of each marker of both boards that was found, by its number."""

    @property
    def ok(self) -> bool:
        return self.status is TrackStatus.OK

    def pose(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, "3 3"]]:
        """``(position, rotation)``.

        Raises:
            ObjectLostError: there is none in this frame.
        """
        if self.position is None or self.rotation is None:
            remedy = "take the next frame, or clear the line of sight"
            raise ObjectLostError(f"no pose in this frame: {self.status.value}; {remedy}")
        return self.position, self.rotation


class MarkerTracker:
    r"""``T_hand,object = T_hand,palm T_camera,palm^-1 T_camera,object T_object,board^-1``.

    Each image is searched for the markers of two boards (section III.C of the paper: one on the palm,
    one on the object). What comes out is the object's frame in the hand frame, its covariance, or the
    reason why there is none. Only the last accepted pose is remembered, to detect flips and jumps.

    The covariance follows from both boards' by ``do_h = M (do_c - dt_p - dphi_p x (o_c - t_p))``,
    ``dphi_h = M (dphi_b - dphi_p)``, with ``M`` the rotation from camera to hand axes.

    Args:
        camera: the lens, as calibrated.
        palm_board: its ``mount`` is its pose in the hand frame.
        object_board: its ``mount`` is its pose in the object's frame
            (``ObjectDescription.marker_transform``).

    Raises:
        ParameterError: the two boards share markers, or are of different dictionaries.
    """

    def __init__(self, camera: PinholeCamera, palm_board: MarkerBoard, object_board: MarkerBoard) -> None:
        if set(palm_board.ids) & set(object_board.ids):
            valid = f"beyond the palm's {palm_board.ids}"
            raise ParameterError("object_board.first_id", object_board.first_id, valid)
        if palm_board.dictionary != object_board.dictionary:
            raise ParameterError("object_board.dictionary", object_board.dictionary, palm_board.dictionary)
        self.camera, self.palm_board, self.object_board = camera, palm_board, object_board
        self._detector = _make_detector(palm_board.dictionary)
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames (a new object, a new grasp)."""
        self._prior: dict[int, Array] = {}
        self._last: tuple[Array, Array] | None = None
        self._jumps: list[tuple[Array, Array]] = []

    def track(self, image: NDArray[np.uint8] | None) -> Track:
        """Look for both boards in a grey ``(h, w)`` or BGR ``(h, w, 3)`` image; None is a dropped frame.

        Raises:
            ShapeError: the image is not of the camera's size.
        """
        if image is None:
            return Track(TrackStatus.NO_IMAGE)
        grey = self._grey(image)
        markers = self._detect(grey)
        boards = self.palm_board, self.object_board
        poses = [self._board_pose(board, markers, grey) for board in boards]
        track = Track(TrackStatus.JUMP, palm=poses[0], object=poses[1], markers=markers)
        seen: list[BoardPose] = []
        hidden = TrackStatus.PALM_HIDDEN, TrackStatus.OBJECT_HIDDEN
        for board, pose, unseen in zip(boards, poses, hidden, strict=True):
            if pose is None:
                return replace(track, status=unseen)
            if pose.ambiguous and id(board) not in self._prior:
                return replace(track, status=TrackStatus.AMBIGUOUS)
            seen.append(pose)
        position, rotation, covariance = self._object_in_hand(*seen)
        if not self._believable(position, rotation):
            return track
        self._prior = {id(board): pose.rotation for board, pose in zip(boards, seen, strict=True)}
        o, R, P = (torch.from_numpy(array) for array in (position, rotation, covariance))
        return replace(track, status=TrackStatus.OK, position=o, rotation=R, covariance=P)

    def _grey(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        cv2, size = require("cv2"), (self.camera.height, self.camera.width)
        image = np.asarray(image)
        if image.shape[:2] != size or image.shape[2:] not in ((), (3,)):
            raise ShapeError("image", f"{size} or {(*size, 3)}", image.shape, "as the camera's calibration")
        return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

    def _detect(self, grey: NDArray[np.uint8]) -> dict[int, Array]:
        """Corners ``(4, 2)`` [px] of each marker of the boards that was found exactly once."""
        corners, ids, _ = self._detector.detectMarkers(grey)
        flat = [] if ids is None else ids.ravel().tolist()
        ours = {*self.palm_board.ids, *self.object_board.ids}
        once = [(i, k) for i, k in enumerate(flat) if k in ours and flat.count(k) == 1]
        return {k: corners[i].reshape(4, 2).astype(np.float64) for i, k in once}

    def _board_pose(self, board: MarkerBoard, markers: dict[int, Array], grey: NDArray) -> BoardPose | None:
        if sum(k in markers for k in board.ids) < min(_MIN_MARKERS, board.n_markers):
            return None
        return estimate_board_pose(grey, self.camera, board, markers, self._prior.get(id(board)))

    def _object_in_hand(self, palm: BoardPose, obj: BoardPose) -> tuple[Array, Array, Array]:
        """Position, rotation and covariance of the object's frame in the hand frame."""
        R_hp, t_hp = self.palm_board.mount[:3, :3], self.palm_board.mount[:3, 3]
        R_ob, t_ob = self.object_board.mount[:3, :3], self.object_board.mount[:3, 3]
        M = R_hp @ palm.rotation.T
        R_co = obj.rotation @ R_ob.T
        arm = -R_co @ t_ob  # from the card's centre to the object's origin, camera axes
        reach = obj.position + arm - palm.position
        position = M @ reach + t_hp
        covariance = np.zeros((6, 6))
        for board, lever in ((obj, arm), (palm, reach)):
            J = np.block([[M, -M @ hat(lever)], [np.zeros((3, 3)), M]])
            covariance = covariance + J @ board.covariance @ J.T
        return position, M @ R_co, covariance

    def _believable(self, position: Array, rotation: Array) -> bool:
        """Near the last pose, or near a jump that the last frames agreed on."""
        here = position, rotation
        if self._last is not None and not _near(self._last, here):
            agree = bool(self._jumps) and _near(self._jumps[-1], here)
            self._jumps = [*self._jumps, here] if agree else [here]
            if len(self._jumps) < _JUMP_FRAMES:
                return False
        self._jumps, self._last = [], here
        return True


def _near(one: tuple[Array, Array], other: tuple[Array, Array]) -> bool:
    turn, step = angle_between(one[1], other[1]), np.linalg.norm(one[0] - other[0])
    return bool(step <= _MAX_STEP and turn <= _MAX_TURN)


def _make_detector(dictionary: str):
    cv2 = require("cv2")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # half the window in marker cells: 0.5 was the best of 0.3, 0.5, 0.7, 1.0 on 20 mm markers at 0.4 m
    parameters.relativeCornerRefinmentWinSize = 0.5
    parameters.cornerRefinementMinAccuracy = 0.01
    return cv2.aruco.ArucoDetector(get_dictionary(dictionary), parameters)
