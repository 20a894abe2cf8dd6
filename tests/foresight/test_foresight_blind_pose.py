"""A blind turn in the simulated hand: what joints and touch know of the object, and how sure they are."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torch_ekm._noise import NOISE
from torch_ekm.exceptions import ParameterError
from torch_ekm.foresight import BlindPose, blind_pose
from torch_ekm.kinematics.poses import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantStatus, PlantWrapper
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
JOINT, POSITION, ROTATION = NOISE.joint, NOISE.position, NOISE.rotation
MOTIONS = 4


class Replay(PlantWrapper):
    """Motions that were made once, read anew with noise drawn from a seed; scale 0: exact."""

    def __init__(self, plant: Plant, made: list[Observation], seed: int = 0, scale: float = 1.0) -> None:
        super().__init__(plant)
        self.made, self.k, self.scale = made, 0, scale
        self.draw = torch.Generator().manual_seed(seed)

    def observe(self) -> Observation:
        seen = self.made[self.k]
        n = self.scale * torch.randn(len(seen.q) + 6, generator=self.draw, dtype=torch.float64)
        q, o, w = n.split([len(seen.q), 3, 3])
        assert seen.truth is not None
        return dataclasses.replace(
            seen,
            q=seen.truth.q + JOINT * q,
            position=seen.truth.position + POSITION * o,
            rotation=exp(ROTATION * w) @ seen.truth.rotation,
        )

    def command(self, delta_a: torch.Tensor) -> Observation:
        self.k += 1
        return self.observe()


@pytest.fixture(scope="module")
def turned() -> tuple[SimulatedHand, list[Observation]]:
    """A turn by 13 deg of a hand whose tendons run on larger pulleys than the model's."""
    from torch_ekm.control import LookAndMoveController, PoseTarget

    hand = SimulatedHand("icub_right", "box", preset="none")
    hand.change(moment_arm=1.3)
    made = [hand.reset(0)]
    target = PoseTarget.turned(made[0].state, hand.rotation_axis, degrees=20)
    controller = LookAndMoveController(KinematicModel(hand.hand, hand.object), hand.rotation_axis)
    for _ in range(MOTIONS):
        seen = made[-1]
        made.append(
            hand.command(1.5 * controller.decide(seen.state, seen.a, target, seen.fingertip_force).delta_a)
        )
    return hand, made


def blind(turned: tuple[SimulatedHand, list[Observation]], seed: int = 0, scale: float = 1.0, **options):
    hand, made = turned
    model = KinematicModel(hand.hand, hand.object)
    plant = BlindPose(Replay(hand, made, seed, scale), model, hand.rotation_axis, **options)
    plant.observe()
    still = torch.zeros(hand.hand.n_a, dtype=torch.float64)
    return plant, [plant.command(still) for _ in range(MOTIONS)]


def missed(plant: BlindPose, seen: Observation) -> torch.Tensor:
    """Error twist of the pose."""
    assert seen.truth is not None
    return seen.state.minus(seen.truth.state)[-6:]


def test_joints_and_touch_find_what_the_prediction_misses(turned, monkeypatch) -> None:
    hand, made = turned
    assert float(hand.rotation_axis @ made[-1].truth.state.minus(made[0].truth.state)[-3:]) > 6 * DEG
    monkeypatch.setattr(blind_pose, "NOISE", dataclasses.replace(NOISE, joint=1e-3 * DEG))
    plant, seen = blind(turned, scale=0.0)
    alone, predicted = blind(turned, scale=0.0, touch=False)
    error, of_prediction = (
        float(p.axis @ missed(p, s[-1])[3:]) for p, s in ((plant, seen), (alone, predicted))
    )
    assert abs(of_prediction) > 1.2 * DEG  # pulleys of 1.3 times the radius
    assert abs(error) < 0.25 * DEG
    assert float(missed(plant, seen[-1])[:3].norm()) < 3e-4
    # the pads that press touch the object, to a tenth of a millimetre
    gaps = plant.filter.kinematic.detector(seen[-1].q, seen[-1].position, seen[-1].rotation).gap
    assert float(gaps.abs().max()) < 1e-4


def test_without_touch_the_prediction_is_all_there_is(turned) -> None:
    hand, made = turned
    _, seen = blind(turned, scale=0.0, touch=False)
    model = KinematicModel(hand.hand, hand.object)
    first = model.linearize(made[0].truth.state, fingertip_force=made[0].fingertip_force)
    ds = first.step(made[1].a - made[0].a)
    assert torch.allclose(seen[0].state.minus(made[0].truth.state)[-6:], ds[-6:], atol=1e-9)


def test_the_stated_uncertainty_holds(turned) -> None:
    """Whitened errors of 8 noisy readings: neither too small a covariance nor far too large a one."""
    chi2, stds = [], []
    for seed in range(8):
        plant, seen = blind(turned, seed)
        error, P = missed(plant, seen[-1]), plant.filter.pose_covariance
        chi2.append(float(error @ torch.linalg.solve(P, error)) / 6)
        stds = [s.info["estimate"]["axis_std"] for s in seen]
        assert torch.linalg.eigvalsh(P).min() > 0
    assert 0.25 < sum(chi2) / len(chi2) < 1.3
    assert stds == sorted(stds)  # it grows in the dark
    assert stds[-1] < 1.2 * DEG


def test_the_camera_is_asked_when_the_uncertainty_says_so(turned) -> None:
    plant, seen = blind(turned, look_again=0.7 * DEG)
    looked = [s.info["estimate"]["looked"] for s in seen]
    assert plant.looks == sum(looked) > 0
    assert not looked[0]
    assert all(s.info["estimate"]["axis_std"] < 0.3 * DEG for s, at in zip(seen, looked, strict=True) if at)
    assert blind(turned)[0].looks == 0


def test_a_dark_camera_cannot_say_that_it_sees_nothing(turned) -> None:
    hand, made = turned
    unseen = [made[0], *(dataclasses.replace(s, status=PlantStatus.NOT_SEEN) for s in made[1:])]
    plant, seen = blind((hand, unseen), look_again=1e-6)
    assert all(s.status is PlantStatus.HELD for s in seen)
    assert plant.looks == 0


def test_it_sees_after_a_reset(turned) -> None:
    hand, _ = turned
    plant = blind(turned, scale=0.0)[0]
    plant.plant.k, plant.plant.reset = 1, lambda seed: plant.plant.observe()
    assert "estimate" not in plant.reset(0).info
    assert "estimate" in plant.command(torch.zeros(hand.hand.n_a, dtype=torch.float64)).info


@pytest.mark.parametrize(("field", "place"), [("a", 3), ("q", 5)])
def test_a_reading_that_guards_refuse_changes_nothing_of_the_estimate(turned, field: str, place: int) -> None:
    class Glitch(Replay):
        """The first look after the second motion is wrong; a loop looks again."""

        def command(self, delta_a: torch.Tensor) -> Observation:
            seen = super().command(delta_a)
            if self.k != 2:
                return seen
            value = getattr(seen, field).clone()
            value[place] += 0.9
            return dataclasses.replace(seen, **{field: value})

    hand, made = turned
    plants = [
        BlindPose(kind(hand, made, scale=0.0), KinematicModel(hand.hand, hand.object), hand.rotation_axis)
        for kind in (Replay, Glitch)
    ]
    for plant in plants:
        plant.observe()
        for _ in range(MOTIONS):
            plant.command(torch.zeros(hand.hand.n_a, dtype=torch.float64))
            if plant.plant.k == 2:
                plant.observe()
    clean, spoilt = (plant.filter.state for plant in plants)
    assert float(spoilt.minus(clean)[-6:].abs().max()) < 2e-3  # one look fewer, and no more
    assert float(clean.minus(made[0].state)[-3:].norm()) > 5 * DEG


def test_figures_that_make_no_sense_are_refused(turned) -> None:
    hand, _ = turned
    model = KinematicModel(hand.hand, hand.object)
    with pytest.raises(ParameterError, match="look_again"):
        BlindPose(hand, model, hand.rotation_axis, look_again=0.0)
    with pytest.raises(ParameterError, match="axis"):
        BlindPose(hand, model, torch.zeros(3, dtype=torch.float64))
