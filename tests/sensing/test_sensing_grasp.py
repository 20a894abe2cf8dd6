"""A hand with an object before the camera, and a plant that is known through its sensors only."""

import dataclasses

import numpy as np
import pytest
import torch
from fakes import FakePlant

from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import ObjectLostError, ParameterError, StateError
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.plant import Observation, Plant, PlantStatus, Truth
from torch_ekm.sensing import MarkerBoard, MarkerTracker, TrackStatus
from torch_ekm.simulation import HallSensors, SensedPlant
from torch_ekm.simulation.imaging.card_scene import camera_facing, grasp_scene
from torch_ekm.simulation.sensed_plant import ICUB_PALM_MOUNT

DEG = np.pi / 180


@pytest.fixture(scope="module")
def hand():
    return load_hand("icub_right")


@pytest.fixture(scope="module")
def obj():
    return load_object("box")


def grasp(hand, turn_deg=0.0):
    """A pinch, about: thumb against index and middle, the object's long axis towards the little finger."""
    angles = dict.fromkeys(hand.joint_names, 0.0)
    angles |= {"thumb_0": 50.0, "thumb_1": 17.0, "thumb_2": 19.0, "thumb_3": 40.0}
    angles |= {f"{f}_{k}": v for f in ("index", "middle") for k, v in ((1, 15.0), (2, 20.0), (3, 35.0))}
    angles |= {f"{f}_{k}": 30.0 for f in ("ring", "little") for k in (1, 2, 3)}
    q = torch.tensor([angles[name] for name in hand.joint_names], dtype=torch.float64) * DEG
    R = torch.tensor([[0.0, 0.7, -0.7], [1, 0, 0], [0, -0.7, -0.7]], dtype=torch.float64)
    U, _, Vt = torch.linalg.svd(R)
    turned = exp(torch.tensor([0.0, turn_deg * DEG, 0.0], dtype=torch.float64)) @ U @ Vt
    return q, torch.tensor([0.035, -0.012, 0.045], dtype=torch.float64), turned


class Puppet(FakePlant):
    """A plant that turns its object by ``delta_a[0]`` and moves nothing else."""

    def __init__(self, hand):
        self.hand, self.turn = hand, 0.0

    def reset(self, seed):
        self.turn = 0.0
        return self.observe()

    def observe(self):
        q, position, rotation = grasp(self.hand, self.turn / DEG)
        a = q @ torch.from_numpy(self.hand.actuation_jacobian).mT + torch.from_numpy(
            self.hand.actuator_offset
        )
        truth = Truth(q, position, rotation)
        wrong = torch.zeros_like(position)  # nobody may read the pose but from the images
        return Observation(q, a, wrong, torch.eye(3).double(), torch.ones(3), truth=truth)

    def move(self, delta_a):
        self.turn += float(delta_a[0])


def test_scene_is_the_grasp_seen_from_the_camera(hand, obj):
    palm, board = MarkerBoard(0, mount=ICUB_PALM_MOUNT), MarkerBoard(4, mount=obj.marker_transform)
    q, position, rotation = grasp(hand)
    camera_pose = camera_facing(palm.mount, np.eye(4) + 0.05)
    scene = grasp_scene(hand, obj, (palm, board), camera_pose, GraspState(q, position, rotation))
    back = [camera_pose @ card.pose for card in scene.cards]
    np.testing.assert_allclose(back[0], ICUB_PALM_MOUNT, atol=1e-12)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = rotation, position
    np.testing.assert_allclose(back[1], expected @ obj.marker_transform, atol=1e-12)
    # the tip of the index finger: a ball of its last link's capsule, where kinematics puts it
    pad = next(pad for pad in hand.pads if pad.name.startswith("index"))
    link = HandKinematics(hand)(q).of(pad.link).numpy()
    tip = np.linalg.inv(camera_pose) @ link @ [*pad.end, 1.0]
    nearest = min(np.linalg.norm(body.centres - tip[:3], axis=1).min() for body in scene.bodies)
    assert nearest < 1.5e-3


def test_camera_faces_both_cards(obj, pose_of):
    palm, other = ICUB_PALM_MOUNT, pose_of(0.02, 0.04, 0.06, 70, 30, 10) @ np.diag([1.0, -1, -1, 1])
    pose = camera_facing(palm, other)
    middle = (palm[:3, 3] + other[:3, 3]) / 2
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(pose[:3, 3] + 0.4 * pose[:3, 2], middle, atol=1e-12)
    assert pose[:3, 2] @ palm[:3, 2] == pytest.approx(pose[:3, 2] @ other[:3, 2])
    assert pose[:3, 2] @ palm[:3, 2] < 0
    away = other.copy()
    away[:3, :3] = palm[:3, :3] @ np.diag([1.0, -1, -1])
    with pytest.raises(ParameterError, match="160 deg"):
        camera_facing(palm, away)
    with pytest.raises(ParameterError, match="to the side"):
        camera_facing(palm, palm)


def test_sensed_plant_knows_only_what_its_sensors_say(hand, obj):
    hall = HallSensors(hand, seed=1)
    plant = SensedPlant(Puppet(hand), hand, obj, hall=hall)
    assert isinstance(plant, Plant)
    observation = plant.reset(seed=7)
    turn = torch.zeros(hand.n_a, dtype=torch.float64)
    turn[0] = 4 * DEG
    for _ in range(4):
        truth = observation.truth
        assert observation.status is PlantStatus.HELD
        assert observation.info["track"].ok
        assert observation.info["raw"]["hall"].shape == (15,)
        assert (observation.position - truth.position).norm() < 1e-3
        assert 0 < log(observation.rotation @ truth.rotation.mT).norm() < 0.5 * DEG
        has_channel = [hand.joint_names.index(joint) for joint in hall.joints]
        error = (observation.q - truth.q)[has_channel]
        assert 0 < error.square().mean().sqrt() < 1.0 * DEG
        observation = plant.command(turn)
    moved = log(observation.rotation @ grasp(hand)[2].mT)
    torch.testing.assert_close(moved[1], torch.tensor(16 * DEG).double(), atol=0.5 * DEG, rtol=0)
    plant.close()


def test_same_seed_same_observations(hand, obj):
    plant, twin = (SensedPlant(Puppet(hand), hand, obj, hall=HallSensors(hand, seed=1)) for _ in range(2))
    first, other, again, elsewhere = plant.reset(3), plant.reset(4), plant.reset(3), twin.reset(3)
    for same in (again, elsewhere):
        assert torch.equal(first.position, same.position)
        assert torch.equal(first.info["raw"]["hall"], same.info["raw"]["hall"])
        assert torch.equal(first.q, same.q)
    assert not torch.equal(first.position, other.position)
    assert not torch.equal(first.info["raw"]["hall"], other.info["raw"]["hall"])


def test_object_not_seen_is_said(hand, obj):
    class Hidden(Puppet):
        def observe(self):
            return dataclasses.replace(super().observe(), status=PlantStatus.NOT_SEEN)

    plant = SensedPlant(Hidden(hand), hand, obj)
    with pytest.raises(StateError, match="reset"):
        plant.observe()
    with pytest.raises(ObjectLostError, match="5 frames"):
        plant.reset(seed=0)


def test_what_the_inner_plant_does_not_see_is_hidden_in_the_pictures(hand, obj):
    class Occluded(Puppet):
        def command(self, delta_a):
            return dataclasses.replace(super().command(delta_a), status=PlantStatus.NOT_SEEN)

    plant = SensedPlant(Occluded(hand), hand, obj)
    first = plant.reset(seed=0)
    unseen = plant.command(torch.full((hand.n_a,), 2 * DEG))
    assert unseen.status is PlantStatus.NOT_SEEN
    assert unseen.info["track"].status is TrackStatus.OBJECT_HIDDEN
    assert torch.equal(unseen.position, first.position)
    assert unseen.info["estimate"]["pose_covariance"].isnan().all()
    assert unseen.info["raw"]["corners"].isnan().any()


def test_the_camera_shows_the_picture_that_has_arrived(hand, obj):
    """A late picture shows the object where it was; the joint sensors are not late."""

    class Late(Puppet):
        def command(self, delta_a):
            before = super().observe().truth
            now = super().command(delta_a)
            return dataclasses.replace(now, truth=dataclasses.replace(now.truth, pictured=before.state))

    plant = SensedPlant(Late(hand), hand, obj, hall=HallSensors(hand, seed=1))
    first = plant.reset(seed=0)
    late = plant.command(torch.full((hand.n_a,), 6 * DEG))
    assert log(late.rotation @ first.rotation.mT).norm() < 0.5 * DEG
    assert log(late.truth.rotation @ first.rotation.mT).norm() > 5 * DEG


def test_raw_readings_of_an_observation(hand, obj):
    plant = SensedPlant(Puppet(hand), hand, obj, hall=HallSensors(hand, seed=1), keep_images=True)
    seen = plant.reset(seed=0)
    corners, image = seen.info["raw"]["corners"].numpy(), seen.info["raw"]["image"].numpy()
    assert corners.shape == (8, 4, 2)
    assert image.shape == (480, 640)
    again = MarkerTracker(plant.camera.camera, *plant.boards).track(image)
    assert torch.equal(again.position, seen.position)
    np.testing.assert_array_equal(corners[5], again.markers[5])
    assert np.isfinite(corners).all()


@pytest.mark.parametrize(
    ("name", "turn"),
    [("toothpaste", -29.0), ("applier", 29.0), ("box", -29.0), ("bottle", 29.0), ("can", -29.0)],
)
def test_every_object_is_seen_over_the_range_of_turns(hand, name, turn, simulated, rng):
    """Neither fingers nor palm nor object hide the boards: the default places of board and camera work."""
    obj = load_object(name)
    palm, board = MarkerBoard(0, mount=ICUB_PALM_MOUNT), MarkerBoard(4, mount=obj.marker_transform)
    q, position, rotation = grasp(hand)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    camera_pose = camera_facing(palm.mount, pose @ board.mount)
    q, position, rotation = grasp(hand, turn)
    tracker = MarkerTracker(simulated.camera, palm, board)
    scene = grasp_scene(hand, obj, (palm, board), camera_pose, GraspState(q, position, rotation))
    track = tracker.track(simulated.render(scene, rng))
    assert track.ok
    assert (track.position - position).norm() < 1e-3
    assert log(track.rotation @ rotation.mT).norm() < 0.5 * DEG
