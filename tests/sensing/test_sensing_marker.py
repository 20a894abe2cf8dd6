"""The tracker: object in hand, covariance, and the reasons why there is no pose."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from torch_ekm.exceptions import ObjectLostError, ParameterError, ShapeError
from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.sensing import MarkerBoard, MarkerTracker, PinholeCamera, Track, TrackStatus
from torch_ekm.sensing.tracker import BoardPose
from torch_ekm.simulation.imaging.card_scene import CardScene, ConvexBody, PlacedCard

PALM, OBJECT = MarkerBoard(0), MarkerBoard(4)


@pytest.fixture
def mounted(pose_of):
    """Boards with mounts that are not the identity."""
    mounts = pose_of(-0.05, 0.01, 0.02, 35, 100, 70), pose_of(0.04, -0.02, 0.03, 60, 10, -50)
    return tuple(
        dataclasses.replace(board, mount=mount) for board, mount in zip((PALM, OBJECT), mounts, strict=True)
    )


def scene_of(pose_of, shift=0.0, turn=0.0, boards=(PALM, OBJECT), bodies=()):
    poses = pose_of(-0.05, tilt_deg=35), pose_of(0.05 + shift, 0.01, tilt_deg=30, spin_deg=20 + turn)
    cards = tuple(PlacedCard(board, pose) for board, pose in zip(boards, poses, strict=True))
    return CardScene(cards, tuple(bodies))


def ball_before(card: PlacedCard) -> ConvexBody:
    return ConvexBody(card.pose[None, :3, 3] * 0.8, np.array([0.035]))


def test_object_in_the_hand_frame(pose_of, mounted, simulated, rng):
    scene = scene_of(pose_of, boards=mounted)
    palm, obj = (card.pose for card in scene.cards)
    truth = mounted[0].mount @ np.linalg.inv(palm) @ obj @ np.linalg.inv(mounted[1].mount)
    track = MarkerTracker(simulated.camera, *mounted).track(simulated.render(scene, rng))
    position, rotation = track.pose()
    assert track.ok
    assert len(track.markers) == 8
    assert position.dtype == rotation.dtype == torch.float64
    assert np.abs(position.numpy() - truth[:3, 3]).max() < 8e-4
    turn = log(rotation @ torch.from_numpy(truth[:3, :3].T.copy()))
    assert torch.rad2deg(turn).abs().max() < 0.4


@pytest.mark.parametrize("which", [0, 1])
def test_covariance_is_carried_into_the_hand_frame(pose_of, mounted, which):
    """One unit of variance along each direction of a board's twist, against finite differences."""
    tracker, h = MarkerTracker(PinholeCamera(), *mounted), 1e-6
    poses = pose_of(-0.05, tilt_deg=35), pose_of(0.05, 0.01, tilt_deg=30)

    def object_in_hand(step, covariance):
        looks = []
        for k, pose in enumerate(poses):
            moved = step if k == which else np.zeros(6)
            turned = exp(torch.from_numpy(moved[3:])).numpy() @ pose[:3, :3]
            known = covariance if k == which else np.zeros((6, 6))
            looks.append(BoardPose(turned, pose[:3, 3] + moved[:3], known, False))
        return tracker._object_in_hand(*looks)

    for direction in np.eye(6):
        (p, R, _), (m, S, _) = (object_in_hand(sign * h * direction, np.eye(6)) for sign in (1, -1))
        column = np.concatenate([p - m, log(torch.from_numpy(R @ S.T)).numpy()]) / (2 * h)
        *_, covariance = object_in_hand(np.zeros(6), np.outer(direction, direction))
        np.testing.assert_allclose(covariance, np.outer(column, column), atol=1e-6)


def test_accuracy_at_nominal_noise(pose_of, simulated):
    """Boards 0.4 m away, tilted up to 50 deg; nothing but the picture tells a pose from its mirror image."""
    tracker, errors, chi2 = MarkerTracker(simulated.camera, PALM, OBJECT), [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        poses = []
        for side in (-1, 1):
            at = [side * 0.048, 0.0, 0.4] + rng.uniform(-1, 1, 3) * [0.015, 0.05, 0.05]
            poses.append(pose_of(*at, rng.uniform(0, 50), *rng.uniform(0, 360, 2)))
        cards = tuple(PlacedCard(*pair) for pair in zip((PALM, OBJECT), poses, strict=True))
        tracker.reset()
        track = tracker.track(simulated.render(CardScene(cards), rng))
        for pose, found in zip(poses, (track.palm, track.object), strict=True):
            turn = log(torch.from_numpy(found.rotation @ pose[:3, :3].T)).numpy()
            offset, normal, sight = found.position - pose[:3, 3], pose[:3, 2], pose[:3, 3]
            about, depth = turn @ normal, offset @ sight / np.linalg.norm(sight)
            across, lateral = np.linalg.norm(turn - about * normal), np.sqrt((offset @ offset - depth**2) / 2)
            errors.append([about, across, lateral, depth])
        truth = np.linalg.inv(poses[0]) @ poses[1]
        turn = log(track.rotation @ torch.from_numpy(truth[:3, :3].T.copy()))
        twist = torch.cat([track.position - torch.from_numpy(truth[:3, 3].copy()), turn])
        chi2.append(float(twist @ torch.linalg.solve(track.covariance, twist)))
    assert 2 < np.mean(chi2) < 10  # 6 where the covariance is right
    about, across, lateral, _ = np.sqrt(np.square(errors).mean(axis=0))
    assert np.degrees(about) < 0.03
    assert np.degrees(across) < 0.2  # without a flip
    assert lateral < 1e-5
    assert abs(np.mean(errors, axis=0)[3]) < 2e-4


@pytest.mark.parametrize(("hidden", "status"), [(0, TrackStatus.PALM_HIDDEN), (1, TrackStatus.OBJECT_HIDDEN)])
def test_hidden_boards_are_reported(pose_of, simulated, rng, hidden, status):
    scene = scene_of(pose_of)
    scene = dataclasses.replace(scene, bodies=(ball_before(scene.cards[hidden]),))
    track = MarkerTracker(simulated.camera, PALM, OBJECT).track(simulated.render(scene, rng))
    assert track.status is status
    assert track.position is None
    assert (track.palm is None, track.object is None) == (hidden == 0, hidden == 1)
    with pytest.raises(ObjectLostError, match=status.value):
        track.pose()


def test_a_finger_over_one_corner_does_not_matter(pose_of, simulated, rng):
    scene = scene_of(pose_of)
    target = scene.cards[1]
    tip = target.outline[0] * 0.85
    finger = ConvexBody(np.stack([tip, tip - [0.0, 0.06, 0.0]]), np.full(2, 0.006))
    tracker = MarkerTracker(simulated.camera, PALM, OBJECT)
    track = tracker.track(simulated.render(dataclasses.replace(scene, bodies=(finger,)), rng))
    assert track.ok
    assert len(track.markers) < 8
    expected = np.linalg.inv(scene.cards[0].pose) @ target.pose
    assert np.abs(track.position.numpy() - expected[:3, 3]).max() < 1e-3
    turn = log(track.rotation @ torch.from_numpy(expected[:3, :3].T.copy()))
    assert torch.rad2deg(turn).abs().max() < 0.6


def test_dropped_frames_and_wrong_images(simulated):
    tracker = MarkerTracker(simulated.camera, PALM, OBJECT)
    assert tracker.track(None) == Track(TrackStatus.NO_IMAGE)
    for shape in ((240, 320), (480, 640, 4), (480,)):
        with pytest.raises(ShapeError, match="image"):
            tracker.track(np.zeros(shape, dtype=np.uint8))


def test_colour_images_are_the_same(pose_of, simulated, rng):
    image = simulated.render(scene_of(pose_of), rng)
    grey, colour = (
        MarkerTracker(simulated.camera, PALM, OBJECT).track(picture)
        for picture in (image, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    )
    torch.testing.assert_close(grey.position, colour.position)


@pytest.mark.parametrize(("shift", "turn"), [(0.035, 0.0), (0.0, 30.0)])
def test_a_jump_is_believed_when_seen_three_times(pose_of, simulated, rng, shift, turn):
    tracker = MarkerTracker(simulated.camera, PALM, OBJECT)
    before, after = scene_of(pose_of), scene_of(pose_of, shift, turn)
    assert tracker.track(simulated.render(before, rng)).ok
    seen = [tracker.track(simulated.render(after, rng)).status for _ in range(4)]
    assert seen == [TrackStatus.JUMP, TrackStatus.JUMP, TrackStatus.OK, TrackStatus.OK]
    # a single outlier is refused, and forgotten
    assert tracker.track(simulated.render(before, rng)).status is TrackStatus.JUMP
    assert tracker.track(simulated.render(after, rng)).ok
    assert tracker.track(simulated.render(before, rng)).status is TrackStatus.JUMP
    tracker.reset()
    assert tracker.track(simulated.render(before, rng)).ok


def test_one_marker_alone_is_not_enough(pose_of, simulated, rng):
    boards = MarkerBoard(0), MarkerBoard(4, columns=2, rows=1)
    scene = scene_of(pose_of, boards=boards)
    card = scene.cards[1]
    corner = card.pose[:3, :3] @ [0.018, 0.0, 0.0] + card.pose[:3, 3]
    scene = dataclasses.replace(scene, bodies=(ConvexBody(0.8 * corner[None], np.array([0.007])),))
    track = MarkerTracker(simulated.camera, *boards).track(simulated.render(scene, rng))
    assert len(track.markers) == 5
    assert track.object is None
    assert track.status is TrackStatus.OBJECT_HIDDEN


def test_boards_must_be_told_apart():
    with pytest.raises(ParameterError, match="first_id"):
        MarkerTracker(PinholeCamera(), PALM, MarkerBoard(3))
