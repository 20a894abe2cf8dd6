"""The pose of an object in the hand frame, from images of two boards of markers, on palm and object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import torch
from numpy.typing import NDArray

from .._extras import require
from ..exceptions import ObjectLostError, ParameterError, ShapeError
from ..kinematics.se3 import hat
from ..typing import Array, Float, Tensor
from .camera import MarkerBoard, PinholeCamera, dictionary

_CORNER_STD = 0.20  # of one coordinate of a detected corner [px]
_MAX_RESIDUAL = 1.0  # a corner farther than this from the fitted board is left out [px]
_MIN_CORNERS = 6  # fewer do not make a pose
_ITERATIONS = 3
_EDGE_STD = 0.03  # of the place of an edge [px]
_REACH = 2.0  # a point of the board that moves farther went to the edge of something else [px]
_PER_SIDE = 12  # places looked at along each side of a marker
_CORRELATED = 3.0  # samples along a side share their errors: three count as one
_STEP = 0.25  # distance of samples across the edge [px]


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Pose of a board in the camera frame, and how well the edges determine it."""

    rotation: Array
    """Board frame to camera frame, ``(3, 3)``."""
    position: Array
    """Centre of the card ``(3,)`` [m]."""
    covariance: Array
    """Of the twist ``(v; w)`` of the card about its centre, camera axes, ``(6, 6)`` [m, rad]."""
    ambiguous: bool
    """Another pose explains the image as well; ``prior`` decided, if one was given."""


def estimate_board_pose(
    image: NDArray[np.uint8],
    camera: PinholeCamera,
    board: MarkerBoard,
    markers: Mapping[int, Array],
    prior: Array | None = None,
) -> BoardPose | None:
    r"""``min_{R, t} sum_i (n_i . (e_i - pi(R X_i + t)))^2``: sides of markers against edges in the image.

    Four corners of a marker rest on a few pixels each, and blur draws detected corners outwards; its
    four sides rest on a hundred pixels, and a symmetric blur leaves an edge where it is. So corners only
    give the start. Across each side the grey level rises from black to white; the area under the profile,
    ``s = s_max - int (I - I_black) / (I_white - I_black) ds``, gives the edge along the normal
    ``n_i``. Places that do not look like an edge of the board (a finger before it, glare) are left
    out, and so are those beyond three robust deviations. Gauss-Newton on the twist, three times.

    A planar target has two local minima, mirrored about the line of sight. Both are computed in closed form
    (IPPE, Collins and Bartoli, IJCV 2014) and refined, unless the second fits the corners worse by a hundred
    units of ``chi^2``. The better one counts; where they differ by more than 10 deg and by less than nine
    units, the result is ``ambiguous``, and the one nearer to ``prior`` is taken.

    Args:
        image: grey levels, ``(height, width)``.
        camera: the lens.
        board: the board whose pose is wanted.
        markers: detected corners ``(4, 2)`` [px] by the marker's number; others than the board's are ignored.
        prior: rotation ``(3, 3)`` of the board that is to be expected.

    Returns:
        The pose with its covariance, or None where too few corners agree or too few edges can be seen.
    """
    starts = _from_corners(camera, board, markers)
    found = [fit for start in starts if (fit := _fit(image, camera, board, *start)) is not None]
    if not found:
        return None
    ambiguous = False
    poses = [pose for pose, _ in found]
    if len(found) == 2:
        seen = [residual[np.isfinite(residual)] for _, residual in found]
        variance = max(_EDGE_STD**2, min(float(np.median(r**2)) * 2.2 for r in seen)) * _CORRELATED
        costs = [float(np.minimum(residual**2 / variance, 9.0).sum()) for _, residual in found]
        poses = [poses[k] for k in np.argsort(costs)]
        apart = angle_between(poses[0].rotation, poses[1].rotation) > np.radians(10)
        ambiguous = bool(apart and abs(costs[1] - costs[0]) < 9)
        if ambiguous and prior is not None:
            poses.sort(key=lambda pose: angle_between(pose.rotation, prior))
    return replace(poses[0], ambiguous=ambiguous)


def _from_corners(
    camera: PinholeCamera, board: MarkerBoard, markers: Mapping[int, Array]
) -> list[tuple[Array, Array]]:
    """Rotation and position of one or both local minima; none where too few corners agree.

    Corners farther than 1 px from the fit, or than four robust deviations, are left out, the worst first: a
    corner half hidden by a finger is found, but at a wrong place.
    """
    seen = [k for k in board.ids if k in markers]
    X = np.concatenate([board.corners[k - board.first_id] for k in seen])
    u = np.concatenate([markers[k] for k in seen])
    while len(X) >= _MIN_CORNERS:
        candidates = sorted(_both_poses(camera, X, u), key=lambda c: float(np.sum(c[2] ** 2)))
        if not candidates:
            break
        residual = np.linalg.norm(candidates[0][2], axis=1)
        limit = min(_MAX_RESIDUAL, 4 * max(_CORNER_STD, float(np.median(residual))))
        worst = int(residual.argmax())
        if residual[worst] <= limit:
            most = float(residual @ residual) + 100 * _CORNER_STD**2
            return [(R, t) for R, t, r in candidates if float(np.sum(r**2)) <= most]
        X, u = (np.delete(each, worst, axis=0) for each in (X, u))
    return []


def _both_poses(camera: PinholeCamera, X: Array, u: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Rotation, position and residuals of the local minima at which the board faces the camera."""
    cv2 = require("cv2")
    lens = camera.matrix, camera.distortion_array
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(X, u[:, None], *lens, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # collinear points
        return
    for start in zip(rvecs, tvecs, strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(X, u[:, None], *lens, *start)
        rotation, position = cv2.Rodrigues(rvec)[0], tvec.ravel()
        seen = X @ rotation.T + position
        if np.all(np.isfinite(seen)) and np.all(seen[:, 2] > 0) and rotation[:, 2] @ position < 0:
            yield rotation, position, u - camera.project(seen)


def _fit(
    image: NDArray, camera: PinholeCamera, board: MarkerBoard, rotation: Array, position: Array
) -> tuple[BoardPose, Array] | None:
    """Gauss-Newton from one start, and the distance of each side point from its edge, infinite where there is
    none ``(n,)`` [px]; None where there are too few edges, or those of something else."""
    X, along = _side_points(board)
    half_width = _half_width(camera, board, rotation, position)
    first = camera.project(X @ rotation.T + position)
    fit = None
    for _ in range(_ITERATIONS):
        J = projection_jacobian(camera, X, rotation, position)
        # dpi/dx of the side's direction is the direction of its picture
        direction = np.einsum("nij,nj->ni", J[:, :, :3], along @ rotation.T)
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        pixel = camera.project(X @ rotation.T + position)
        offset, valid = _edge_offsets(image, pixel, normal, half_width)
        if valid.sum() < 4 * _PER_SIDE or np.ptp(pixel[valid], axis=0).min() < 8:
            return None
        limit = 3 * max(_EDGE_STD, 1.4826 * float(np.median(np.abs(offset[valid]))))
        used = valid & (np.abs(offset) <= limit)
        rows = np.einsum("ni,nij->nj", normal[used], J[used])
        step, *_ = np.linalg.lstsq(rows, offset[used], rcond=None)
        rotation = require("cv2").Rodrigues(step[3:])[0] @ rotation
        position = position + step[:3]
        remaining = offset[used] - rows @ step
        variance = _variance(remaining, np.flatnonzero(used) // _PER_SIDE)
        covariance = np.asarray(variance * np.linalg.inv(rows.T @ rows))
        fit = BoardPose(rotation, position, covariance, False), np.where(valid, offset, np.inf)
    moved = camera.project(X @ rotation.T + position) - first
    return fit if float(np.abs(moved).max()) < _REACH else None


def _variance(residual: Array, side: NDArray[np.int_]) -> float:
    """Of one sample as if all were independent [px^2].

    They are not: light, blur and the raster shift all edges of a side together. What counts is how the
    means of sides scatter, ``sum_s n_s m_s^2 / (n_sides - 6)``, and never less than three times the
    variance of single samples.
    """
    count = np.bincount(side)
    mean = np.bincount(side, residual)[count > 0] / count[count > 0]
    freedom = len(mean) - 6
    between = float(count[count > 0] @ mean**2) / freedom if freedom > 1 else 0.0
    single = float(residual @ residual) / max(len(residual) - 6, 1)
    return max(_CORRELATED * max(_EDGE_STD**2, single), between)


def _side_points(board: MarkerBoard) -> tuple[Array, Array]:
    """Points on all sides and the sides' directions in the board frame, ``(n, 3)`` each.

    In the order of the corners (clockwise seen from before), so that white lies to the left.
    """
    start = board.corners.reshape(-1, 3)
    end = np.roll(board.corners, -1, axis=1).reshape(-1, 3)
    fraction = np.linspace(0.12, 0.88, _PER_SIDE)[None, :, None]
    points = start[:, None] * (1 - fraction) + end[:, None] * fraction
    return points.reshape(-1, 3), np.repeat(end - start, _PER_SIDE, axis=0)


def _half_width(camera: PinholeCamera, board: MarkerBoard, rotation: Array, position: Array) -> float:
    """How far to look across an edge [px]: half of the black rim or of the gap, seen askew.

    Farther out, the blurred bits and neighbours would draw the edge towards themselves. Too narrow a
    look that ends on the slope is harmless: it is cut off alike on both sides.
    """
    cells = 6.0  # of a marker of 4 x 4 bits and its rim
    cosine = abs(rotation[:, 2] @ position) / np.linalg.norm(position)
    narrowest = min(board.marker_size / cells, board.gap, board.margin)
    width = 0.5 * narrowest * camera.fx / position[2] * max(float(cosine), 0.5)
    return float(np.clip(width, 1.0, 3.0))


def _edge_offsets(
    image: NDArray[np.uint8], pixel: Array, normal: Array, half_width: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Signed distance of the edge from ``pixel`` along ``normal`` [px], and whether there is one."""
    n_half = max(2, round(half_width / _STEP))
    s = _STEP * np.arange(-n_half, n_half + 1)
    where = (pixel[:, None] + s[:, None] * normal[:, None]).astype(np.float32)
    profile = require("cv2").remap(image, where, None, 1).astype(np.float64)  # 1: bilinear
    sides = profile.reshape(-1, _PER_SIDE, len(s))
    # levels: of each side, so that the noise of a pixel does not move the edge
    left = np.median(sides[:, :, -2:], axis=(1, 2)).repeat(_PER_SIDE)
    right = np.median(sides[:, :, :2], axis=(1, 2)).repeat(_PER_SIDE)
    contrast = left - right  # n = (-d_v, d_u)
    white, black = np.median(left), np.median(right)
    typical = white - black
    safe = np.where(np.abs(contrast) > 1, contrast, 1.0)
    share = (profile - right[:, None]) / safe[:, None]
    offset = s[-1] - _STEP * (share.sum(axis=1) - 0.5 * (share[:, 0] + share[:, -1]))
    height, width = image.shape
    inside = np.all((where > 0) & (where < [width - 1, height - 1]), axis=(1, 2))
    tolerance = 0.25 * abs(typical)
    valid = (
        inside
        & (np.sign(contrast) == np.sign(typical))
        & (np.abs(left - white) < tolerance)
        & (np.abs(right - black) < tolerance)
        & (np.abs(profile[:, -2:].mean(1) - left) < tolerance)
        & (np.abs(profile[:, :2].mean(1) - right) < tolerance)
        & (np.abs(offset) < 0.6 * s[-1])
    )
    return offset, valid


def projection_jacobian(camera: PinholeCamera, X: Array, rotation: Array, position: Array) -> Array:
    """``du = (dpi/dx) (dt - [R X]x dphi)`` for ``R+ = exp([dphi]x) R``: ``(n, 2, 6)``, columns (v; w)."""
    cv2 = require("cv2")
    rvec = cv2.Rodrigues(rotation)[0]
    _, full = cv2.projectPoints(X, rvec, position, camera.matrix, camera.distortion_array)
    by_position = full[:, 3:6].reshape(-1, 2, 3)  # dpi/dx, since x = R X + t
    by_rotation = -by_position @ hat(X @ rotation.T)
    return np.concatenate([by_position, by_rotation], axis=-1)


def angle_between(a: Array, b: Array) -> float:
    """Angle of the rotation ``a b^T`` between two orientations [rad]."""
    return float(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1)))


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
        ParameterError: the two boards share markers.
    """

    def __init__(self, camera: PinholeCamera, palm_board: MarkerBoard, object_board: MarkerBoard) -> None:
        if set(palm_board.ids) & set(object_board.ids):
            valid = f"beyond the palm's {palm_board.ids}"
            raise ParameterError("object_board.first_id", object_board.first_id, valid)
        self.camera, self.palm_board, self.object_board = camera, palm_board, object_board
        self._detector = _make_detector()
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


def _make_detector():
    cv2 = require("cv2")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # half the window in marker cells: 0.5 was the best of 0.3, 0.5, 0.7, 1.0 on 20 mm markers at 0.4 m
    parameters.relativeCornerRefinmentWinSize = 0.5
    parameters.cornerRefinementMinAccuracy = 0.01
    return cv2.aruco.ArucoDetector(dictionary(), parameters)
