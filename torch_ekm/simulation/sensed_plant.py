"""A simulated hand that is seen by a camera and measured by Hall sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from ..description import HandDescription, ObjectDescription
from ..exceptions import ObjectLostError, StateError
from ..plant import Observation, Plant, PlantStatus, PlantWrapper, Truth
from ..sensing.camera import MarkerBoard
from ..sensing.joint_estimator import HallCalibration, JointEstimator
from ..sensing.tracker import MarkerTracker, Track
from ..typing import Array, Tensor
from .hall_sensors import HallSensors
from .imaging.card_scene import CardScene, camera_facing, grasp_scene
from .imaging.simulated_camera import SimulatedCamera

_LOOKS = 5  # pictures tried for one observation

#: Pose of the palm's marker card in the iCub's palm frame ``(4, 4)`` [m]: its rim clears thumb and knuckles.
ICUB_PALM_MOUNT = np.array([[1.0, 0, 0, -0.048], [0, 1, 0, 0], [0, 0, 1, 0.004], [0, 0, 0, 1]])


class SensedPlant(PlantWrapper):
    """Observations through images and Hall counts instead of the truth.

    The inner plant moves; its ``Observation.truth`` is read by Hall sensors, and drawn by a camera: as it
    is, or as it was when the picture was taken where the inner plant gives it (``Truth.pictured``,
    ``PlantParameters.latency``). Only what :class:`MarkerTracker` and
    :class:`JointEstimator` make of that is passed on. Up to five pictures are tried until one
    shows both boards; if none does, the last pose is repeated with the status NOT_SEEN. Where the inner plant
    does not see its object, something hides it in the pictures.

    ``info`` also holds "track", for a log "raw" (``corners (n, 4, 2)`` [px] of all markers, NaN where not
    found, ``hall`` counts, ``image`` if asked for) and "estimate" (``pose_covariance``, NaN where not
    seen). The same seed gives the same noise.

    Args:
        plant: for example a ``SimulatedHand``.
        hand, obj: what it consists of.
        hall: the Hall channels, calibrated by a sweep of 181 postures; None keeps the inner plant's joint
            angles.
        keep_images: the last image of an observation stays in ``info["raw"]["image"]``.

    Raises:
        ParameterError: the inner plant gives no truth.
    """

    def __init__(
        self,
        plant: Plant,
        hand: HandDescription,
        obj: ObjectDescription,
        hall: HallSensors | None = None,
        keep_images: bool = False,
    ) -> None:
        super().__init__(plant)
        self.hand, self.object, self.keep_images = hand, obj, keep_images
        self.camera = SimulatedCamera()
        palm = MarkerBoard(0, mount=ICUB_PALM_MOUNT)
        self.boards = palm, MarkerBoard(palm.n_markers, mount=obj.marker_transform)
        self.tracker = MarkerTracker(self.camera.camera, *self.boards)
        """Finds the boards, with the exact lens and mounts."""
        self.hall, self.joints = hall, None
        if hall is not None:
            sweep = hall.sweep(181, torch.Generator().manual_seed(0))
            self.joints = JointEstimator(hand, HallCalibration.fit(*sweep, hall.joints))
        self._generator = torch.Generator()
        self._camera_pose: Array | None = None
        self._seed = self._frames = 0
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
        self._camera_pose = camera_facing(palm.mount, pose @ board.mount)
        self._seed = int(np.random.SeedSequence([0, seed]).generate_state(1)[0])
        self._generator.manual_seed(self._seed)
        self._frames, self._last = 0, None
        self.tracker.reset()
        return self.observation(observation)

    def observation(self, seen: Observation) -> Observation:
        """``seen`` with what camera and Hall sensors make of its truth in place of the readings."""
        if self._camera_pose is None:
            raise StateError("there is no grasp yet: call reset(seed) first")
        truth = _truth_of(seen)
        shown = truth.state if truth.pictured is None else truth.pictured
        scene = grasp_scene(self.hand, self.object, self.boards, self._camera_pose, shown)
        if seen.status is PlantStatus.NOT_SEEN:
            scene = scene.obstructed(1)
        track, image = self._look(scene)
        status = seen.status
        if track.ok:
            self._last = *track.pose(), seen.taken.pose
        elif self._last is None:
            raise ObjectLostError(
                f"none of {_LOOKS} frames shows both boards ({track.status.value}): grasp with another seed"
            )
        elif status is PlantStatus.HELD:
            status = PlantStatus.NOT_SEEN
        ids, missing = [number for board in self.boards for number in board.ids], np.full((4, 2), np.nan)
        corners = np.stack([track.markers.get(number, missing) for number in ids])
        q, raw = seen.q, {"corners": torch.from_numpy(corners)}
        unknown = torch.full((6, 6), torch.nan, dtype=torch.float64)
        estimate = {"pose_covariance": unknown if track.covariance is None else track.covariance}
        if self.keep_images:
            raw["image"] = torch.from_numpy(image)
        if self.hall is not None and self.joints is not None:
            raw["hall"] = self.hall.read(truth.q, self._generator)
            q, estimate["joint_covariance"] = self.joints(raw["hall"], seen.a)
        position, rotation, taken = self._last
        stamps = seen.taken._replace(pose=taken)
        info = {**seen.info, "track": track, "raw": raw, "estimate": estimate}
        return dataclasses.replace(
            seen, q=q, position=position, rotation=rotation, status=status, info=info, stamps=stamps
        )

    def _look(self, scene: CardScene) -> tuple[Track, NDArray[np.uint8]]:
        """The first picture that shows both boards, or the last one tried."""
        for _ in range(_LOOKS):
            draw = np.random.default_rng([self._seed, self._frames])  # of this picture, whatever came before
            draw.random(2)  # not used: keeps the noise of earlier versions
            self._frames += 1
            image = self.camera.render(scene, draw)
            track = self.tracker.track(image)
            if track.ok:
                break
        return track, image


def _truth_of(seen: Observation) -> Truth:
    if seen.truth is None:
        raise StateError("an observation without truth: only a simulated plant has something to draw")
    return seen.truth
