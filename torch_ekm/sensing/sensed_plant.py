"""A simulated hand that is seen by a camera and felt by Hall sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from ..description import HandDescription, ObjectDescription
from ..exceptions import ObjectLostError, ParameterError
from ..simulation.plant import Observation, Plant, PlantStatus
from ..typing import Float, Tensor
from .board import MarkerBoard
from .frame import StreamOptions
from .grasp_view import GraspView
from .hall import HallCalibration
from .hall_sensors import HallSensors
from .joint_estimator import JointEstimator
from .marker import MarkerTracker
from .scene import Scene
from .simulated_camera import SimulatedCamera
from .simulated_video import SimulatedVideo
from .track import Track

# the card's rim clears thumb and knuckles; 1 mm above the palm
ICUB_PALM_MOUNT = np.array([[1.0, 0, 0, -0.048], [0, 1, 0, 0], [0, 0, 1, 0.004], [0, 0, 0, 1]])


class SensedPlant:
    """Observations through images and Hall counts instead of the truth; implements :class:`Plant`.

    The inner plant moves; its ``info["truth"]`` (``q``, ``position``, ``rotation``) is drawn by
    a camera and read by Hall sensors, and only what :class:`MarkerTracker` and :class:`JointEstimator`
    make of that is passed on. Up to ``looks`` frames are tried until one shows both boards;
    if none does, the last pose is repeated with the status NOT_SEEN. The hand has come to rest by
    then, so that the latency of the images does not matter here. ``info`` also holds
    "track" and "hall" (the raw counts). The same seed gives the same noise.

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
        stream: rate, dropped and hidden frames, seed.
        looks: frames tried for one observation.

    Raises:
        ParameterError: ``looks`` is less than 1.
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
    ) -> None:
        if looks < 1:
            raise ParameterError("looks", looks, "1 or more")
        self.plant, self.hand, self.object, self.looks, self.distance = plant, hand, obj, looks, distance
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
        self._last: tuple[Tensor, Tensor] | None = None

    def reset(self, seed: int) -> Observation:
        """Grasp anew, and set up the camera so that it sees both boards alike.

        Raises:
            ObjectLostError: none of the looks showed both boards.
        """
        observation = self.plant.reset(seed)
        truth = observation.info["truth"]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = truth["rotation"], truth["position"]
        palm, board = self.boards
        camera_pose = GraspView.facing(palm.mount, pose @ board.mount, self.distance)
        self._view = GraspView(self.hand, self.object, palm, board, camera_pose)
        own = int(np.random.SeedSequence([self.stream.seed, seed]).generate_state(1)[0])
        stream = dataclasses.replace(self.stream, seed=own)
        self._video = SimulatedVideo(self.camera, lambda _: self._scene, stream)
        self._generator.manual_seed(own)
        self._frames, self._last = 0, None
        self.tracker.reset()
        return self._sensed(observation)

    def observe(self) -> Observation:
        """Read the sensors."""
        return self._sensed(self.plant.observe())

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Move the actuators by ``delta_a`` [rad], wait, read the sensors."""
        return self._sensed(self.plant.command(delta_a))

    def close(self) -> None:
        self.plant.close()

    def _sensed(self, observation: Observation) -> Observation:
        if self._view is None:
            raise ParameterError("SensedPlant", "not started", "reset with reset(seed) first")
        truth = observation.info["truth"]
        self._scene: Scene = self._view.scene(truth["q"], truth["position"], truth["rotation"])
        track = self._look()
        status = observation.status
        if track.ok:
            self._last = track.pose()
        elif self._last is None:
            raise ObjectLostError(
                f"none of {self.looks} frames shows both boards ({track.status.value}): another camera "
                "distance or palm_mount may help"
            )
        elif status is PlantStatus.HELD:
            status = PlantStatus.NOT_SEEN
        q, info = observation.q, {**observation.info, "track": track}
        if self.hall is not None and self.joints is not None:
            info["hall"] = self.hall.read(truth["q"], self._generator)
            q = self.joints(info["hall"], observation.a).q
        position, rotation = self._last
        return dataclasses.replace(
            observation, q=q, position=position, rotation=rotation, status=status, info=info
        )

    def _look(self) -> Track:
        assert self._video is not None
        track = None
        for _ in range(self.looks):
            track = self.tracker.track(self._video.frame(self._frames).image)
            self._frames += 1
            if track.ok:
                break
        assert track is not None
        return track
