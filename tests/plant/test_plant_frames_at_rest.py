"""The mean of several readings at rest."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from fakes import FakePlant

from torch_ekm.exceptions import ParameterError
from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.plant import FramesAtRest, Observation, PlantStatus

DEG = math.pi / 180
NOISE = torch.tensor([2e-4] * 3 + [0.15 * DEG] * 3, dtype=torch.float64)
POSE = exp(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))


class Noisy(FakePlant):
    """A hand at rest; ``change(k, observation)`` spoils the k-th reading."""

    def __init__(self, noise=NOISE, change=lambda _, seen: seen, covariance=False) -> None:
        self.noise, self.change, self.covariance, self.count = noise, change, covariance, 0
        self.generator = torch.Generator().manual_seed(0)

    def observe(self) -> Observation:
        e = self.noise * torch.randn(6, dtype=torch.float64, generator=self.generator)
        q = e[:2]
        stated = {"pose_covariance": torch.diag(self.noise**2)} if self.covariance else {}
        info = {"estimate": stated, "k": self.count}
        seen = Observation(q, q[:1], e[:3], exp(e[3:]) @ POSE, q[:1], time=float(self.count), info=info)
        self.count += 1
        return self.change(self.count - 1, seen)

    def command(self, delta_a: torch.Tensor) -> Observation:
        return dataclasses.replace(self.observe(), info={"events": ("tug",)})


def errors(plant: Noisy, frames: int, n: int = 300) -> torch.Tensor:
    rested = FramesAtRest(plant, frames)
    seen = [rested.observe() for _ in range(n)]
    return torch.stack([torch.cat([o.position, log(o.rotation @ POSE.mT)]) for o in seen])


def test_noise_falls_with_the_root_of_the_frames() -> None:
    one, six = errors(Noisy(), 1).std(0), errors(Noisy(), 6).std(0)
    torch.testing.assert_close(six / one, torch.full((6,), 6**-0.5).double(), rtol=0.15, atol=0)
    seen = FramesAtRest(Noisy()).observe()
    readings = [Noisy.observe(plant) for plant in [Noisy()] for _ in range(6)]
    torch.testing.assert_close(seen.q, torch.stack([o.q for o in readings]).mean(0))
    torch.testing.assert_close(seen.fingertip_force, torch.stack([o.q[:1] for o in readings]).mean(0))
    assert (seen.time, seen.info["k"]) == (5.0, 5)


@pytest.mark.parametrize("stated", [True, False])
def test_covariance_is_that_of_the_mean(stated: bool) -> None:
    rested = FramesAtRest(Noisy(covariance=stated), 6)
    covariance = [rested.observe().info["estimate"]["pose_covariance"] for _ in range(200)]
    expected = torch.diag(NOISE**2) / 6
    torch.testing.assert_close(torch.stack(covariance).mean(0), expected, rtol=0.12, atol=1e-20)


@pytest.mark.parametrize("place", [0, 4])
def test_one_outlier_is_left_out(place: int) -> None:
    def spoil(k: int, seen: Observation) -> Observation:
        if k % 6 != place:
            return seen
        turn = exp(torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64))
        shift = 0.02 if place else 0.0  # of the first frame only the rotation is wrong
        return dataclasses.replace(seen, rotation=turn @ seen.rotation, position=seen.position + shift)

    clean, spoilt = errors(Noisy(), 6, 100), errors(Noisy(change=spoil), 6, 100)
    assert bool((spoilt.abs().amax(0) < 4 * 6**-0.5 * 1.2 * NOISE).all())
    assert bool((spoilt.std(0) < 1.3 * clean.std(0)).all())


def test_frames_that_do_not_show_the_object_do_not_count() -> None:
    def hide(k: int, seen: Observation) -> Observation:
        stale = dataclasses.replace(seen, status=PlantStatus.NOT_SEEN, position=seen.position + 1)
        return stale if k < 5 else seen

    seen = FramesAtRest(Noisy(change=hide), 6).reset(0)
    assert seen.status is PlantStatus.HELD
    assert float(seen.position.abs().max()) < 1e-3
    assert bool(seen.info["estimate"]["pose_covariance"].isnan().all())  # one frame has no scatter
    never = FramesAtRest(Noisy(change=hide), 5).reset(0)
    assert never.status is PlantStatus.NOT_SEEN
    assert float(never.position.min()) > 0.9  # the last one known


def test_lost_object_is_told_at_once_and_nothing_is_lost_of_what_happened() -> None:
    plant = Noisy(change=lambda k, seen: dataclasses.replace(seen, status=PlantStatus.LOST))
    assert FramesAtRest(plant).observe().status is PlantStatus.LOST
    assert plant.count == 1
    assert FramesAtRest(Noisy()).command(torch.zeros(1)).info["events"] == ("tug",)


def test_without_noise_or_with_one_frame_nothing_changes() -> None:
    seen = FramesAtRest(Noisy(0 * NOISE)).observe()
    torch.testing.assert_close(seen.rotation, POSE, rtol=0, atol=1e-15)
    plain, one = Noisy().observe(), FramesAtRest(Noisy(), 1).observe()
    assert torch.equal(plain.rotation, one.rotation)
    assert one.info == plain.info
    blind = FramesAtRest(Noisy(change=lambda _, seen: dataclasses.replace(seen, fingertip_force=None)))
    assert blind.observe().fingertip_force is None
    with pytest.raises(ParameterError, match="frames"):
        FramesAtRest(Noisy(), 0)
