"""A simulated hand that is seen by a camera and felt by Hall sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from ..description import HandDescription, ObjectDescription
from ..exceptions import ObjectLostError, ParameterError
from ..plant import Observation, Plant, PlantStatus, PlantWrapper, Truth
from ..sensing.hall.calibration import HallCalibration
from ..sensing.joint_estimator import JointEstimator
from ..sensing.vision.board import MarkerBoard
from ..sensing.vision.sources import StreamOptions
from ..sensing.vision.track import Track
from ..sensing.vision.tracker import MarkerTracker
from ..typing import Float, Tensor
from .hall_sensors import HallSensors
from .imaging.card_scene import CardScene
from .imaging.grasp_view import GraspView
from .imaging.simulated_camera import SimulatedCamera
from .imaging.simulated_video import SimulatedVideo

#: Pose of the palm's marker card in the iCub's palm frame ``(4, 4)`` [m]: its rim clears thumb and knuckles.
ICUB_PALM_MOUNT = np.array([[1.0, 0, 0, -0.048], [0, 1, 0, 0], [0, 0, 1, 0.004], [0, 0, 0, 1]])


class SensedPlant(PlantWrapper):
    """Observations through images and Hall counts instead of the truth.

    The inner plant moves; its ``Observation.truth`` is read by Hall sensors, and drawn by a camera: as it
    is, or as it was when the picture was taken where the inner plant tells (``Truth.pictured``,
    ``PlantParameters.latency``). Only what :class:`MarkerTracker` and
    :class:`JointEstimator` make of that is passed on. Up to ``looks`` frames are tried until one shows
    both boards; if none does, the last pose is repeated with the status NOT_SEEN. Where the inner plant
    does not see its object, something hides it in the pictures.

    ``info`` also holds "track", for a log "raw" (``corners (n, 4, 2)`` [px] of all markers, NaN where not
    found, ``hall`` counts, ``image`` if asked for) and "estimate" (``pose_covariance``, NaN where not
    seen). The same seed gives the same noise.

    Args:
        plant: for example a ``SimulatedHand``.
        hand, obj: what it consists of.
        palm_mount: pose of the palm's board in the hand frame, ``(4, 4)``.
        camera: draws the images.
        tracker: finds the boards; by default one that knows the lens and the mounts exactly. Give one
            with a calibrated lens, or with mounts as measured, to include the errors of both.
        hall: the Hall channels; None keeps the inner plant's joint angles.
        calibration: of these channels; None: from a sweep of 181 postures, at construction.
        distance: of the camera from the middle between the boards [m].
        stream: dropped and hidden frames, seed; its latency is not used.
        looks: frames tried for one observation.
        keep_images: the last image of an observation stays in ``info["raw"]["image"]``.

    Raises:
        ParameterError: ``looks`` is less than 1, or the inner plant tells no truth.
    """

    def __init__(
        self,
        plant: Plant,
        hand: HandDescription,
        obj: ObjectDescription,
        palm_mount: np.ndarray = ICUB_PALM_MOUNT,
        camera: SimulatedCamera | None = None,
        tracker: MarkerTracker | None = None,
        hall: HallSensors | None = None,
        calibration: HallCalibration | None = None,
        distance: float = 0.40,
        stream: StreamOptions | None = None,
        looks: int = 5,
        keep_images: bool = False,
    ) -> None:
        if looks < 1:
            raise ParameterError("looks", looks, "1 or more")
        super().__init__(plant)
        self.hand, self.object, self.looks, self.distance = hand, obj, looks, distance
        self.keep_images = keep_images
        self.camera, self.stream = camera or SimulatedCamera(), stream or StreamOptions()
        palm = MarkerBoard(0) if tracker is None else tracker.palm_board
        board = MarkerBoard(palm.n_markers) if tracker is None else tracker.object_board
        self.boards = (
            dataclasses.replace(palm, mount=palm_mount),
            dataclasses.replace(board, mount=obj.marker_transform),
        )
        self.tracker = tracker or MarkerTracker(self.camera.camera, *self.boards)
        self.hall, self.joints = hall, None
        if hall is not None:
            sweep = hall.sweep(181, torch.Generator().manual_seed(0))
            self.joints = JointEstimator(hand, calibration or HallCalibration.fit(*sweep, hall.joints))
        self._generator = torch.Generator()
        self._view: GraspView | None = None
        self._video: SimulatedVideo | None = None
        self._frames = 0
        self._last: tuple[Tensor, Tensor, float] | None = None

    def reset(self, seed: int) -> Observation:
        """Grasp again, and set up the camera so that it sees both boards alike.

        Raises:
            ObjectLostError: none of the looks showed both boards.
        """
        observation = self.plant.reset(seed)
        truth = _truth_of(observation)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = truth.rotation, truth.position
        palm, board = self.boards
        camera_pose = GraspView.facing(palm.mount, pose @ board.mount, self.distance)
        self._view = GraspView(self.hand, self.object, palm, board, camera_pose)
        own = int(np.random.SeedSequence([self.stream.seed, seed]).generate_state(1)[0])
        stream = dataclasses.replace(self.stream, seed=own)
        self._video = SimulatedVideo(self.camera, lambda _: self._scene, stream)
        self._generator.manual_seed(own)
        self._frames, self._last = 0, None
        self.tracker.reset()
        return self.observation(observation)

    def observation(self, seen: Observation) -> Observation:
        """``seen`` with what camera and Hall sensors make of its truth in place of the readings."""
        if self._view is None:
            raise ParameterError("SensedPlant", "not started", "reset with reset(seed) first")
        truth = _truth_of(seen)
        shown = truth.state if truth.pictured is None else truth.pictured
        self._scene: CardScene = self._view.scene(shown.q, shown.position, shown.rotation)
        if seen.status is PlantStatus.NOT_SEEN:
            self._scene = self._scene.obstructed(1)
        track, image = self._look()
        status = seen.status
        if track.ok:
            self._last = *track.pose(), seen.taken.pose
        elif self._last is None:
            raise ObjectLostError(
                f"none of {self.looks} frames shows both boards ({track.status.value}): another camera "
                "distance or palm_mount may help"
            )
        elif status is PlantStatus.HELD:
            status = PlantStatus.NOT_SEEN
        q, raw = seen.q, {"corners": self._corners(track)}
        if self.keep_images:
            raw["image"] = torch.from_numpy(image)
        if self.hall is not None and self.joints is not None:
            raw["hall"] = self.hall.read(truth.q, self._generator)
            q = self.joints(raw["hall"], seen.a).q
        unknown = torch.full((6, 6), torch.nan, dtype=torch.float64)
        estimate = {"pose_covariance": unknown if track.covariance is None else track.covariance}
        position, rotation, taken = self._last
        stamps = seen.taken._replace(pose=taken)
        info = {**seen.info, "track": track, "raw": raw, "estimate": estimate}
        return dataclasses.replace(
            seen, q=q, position=position, rotation=rotation, status=status, info=info, stamps=stamps
        )

    def _look(self) -> tuple[Track, NDArray[np.uint8]]:
        """The first frame that shows both boards, or the last one tried; a dropped frame is black."""
        assert self._video is not None
        track = image = None
        for _ in range(self.looks):
            image = self._video.frame(self._frames).image
            track = self.tracker.track(image)
            self._frames += 1
            if track.ok:
                break
        assert track is not None
        lens = self.camera.camera
        return track, np.zeros((lens.height, lens.width), dtype=np.uint8) if image is None else image

    def _corners(self, track: Track) -> Float[Tensor, "n 4 2"]:
        """Of all markers of both boards [px], NaN where not found."""
        ids = [number for board in self.boards for number in board.ids]
        missing = np.full((4, 2), np.nan)
        return torch.from_numpy(np.stack([track.markers.get(number, missing) for number in ids]))


def _truth_of(seen: Observation) -> Truth:
    if seen.truth is None:
        raise ParameterError("Observation.truth", None, "that of a simulation: there is nothing to draw")
    return seen.truth
