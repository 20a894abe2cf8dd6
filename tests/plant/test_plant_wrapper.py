"""What is put around a plant passes on all that it does not change; the mean of several readings at rest."""

import dataclasses
import math

import pytest
import torch
from fakes import FakePlant, ScriptedPlant

from torch_ekm.exceptions import NonFiniteError, ParameterError, StateError
from torch_ekm.kinematics.se3 import exp, log
from torch_ekm.plant import (
    FramesAtRest,
    Observation,
    Plant,
    PlantStatus,
    PlantWrapper,
    RecordingPlant,
    ReplayedPlant,
    Stamps,
    Trajectory,
    Truth,
)

EYE, ORIGIN = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)


class Counter(FakePlant):
    """Reports how often it was commanded."""

    rotation_axis = "beyond the contract"

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def reset(self, seed: int) -> Observation:
        self.count = seed
        return self.observe()

    def observe(self) -> Observation:
        q = torch.full((2,), float(self.count), dtype=torch.float64)
        return Observation(q, q[:1], ORIGIN, EYE, q[:1], truth=Truth(q, ORIGIN, EYE))

    def move(self, delta_a: torch.Tensor) -> None:
        self.count += int(delta_a)


class Shifted(PlantWrapper):
    """Joints read 10 too large."""

    def observation(self, seen: Observation) -> Observation:
        return dataclasses.replace(seen, q=seen.q + 10)


def test_a_wrapper_changes_every_observation_and_nothing_else() -> None:
    inner = Counter()
    plant = Shifted(Shifted(inner))
    assert isinstance(plant, Plant)
    assert float(plant.reset(3).q[0]) == 23
    assert float(plant.command(torch.tensor(2)).q[0]) == 25
    assert float(plant.observe().q[0]) == 25
    assert float(plant.observe().a[0]) == 5
    assert float(plant.observe().truth.q[0]) == 5
    assert plant.rotation_axis == "beyond the contract"
    plant.close()
    assert inner.closed


def test_what_no_plant_has_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = Shifted(Counter()).no_such_thing
    with pytest.raises(AttributeError, match="_private"):
        _ = Shifted(Counter())._private


def test_states_of_an_observation() -> None:
    seen = Shifted(Counter()).reset(1)
    assert torch.equal(seen.state.q, seen.q)
    assert torch.equal(seen.truth.state.q, seen.q - 10)
    with pytest.raises(NonFiniteError, match=r"Observation\.q"):
        dataclasses.replace(seen, q=seen.q * torch.nan)


@pytest.mark.usefixtures("unchecked")
def test_an_array_where_a_tensor_is_expected_is_named() -> None:
    seen = Counter().reset(1)
    for value in (seen.q.numpy(), seen.q.tolist(), None):
        with pytest.raises(ParameterError, match=r"Observation\.q = .*it must be a torch tensor"):
            dataclasses.replace(seen, q=value)
    assert dataclasses.replace(seen, fingertip_force=None).fingertip_force is None


def test_the_last_reading_before_a_command_is_the_one_that_counts() -> None:
    """What a controller acted on; what had happened stays noted, and an earlier grasp is left out."""

    class Eventful(Counter):
        def command(self, delta_a: torch.Tensor) -> Observation:
            return dataclasses.replace(super().command(delta_a), info={"events": ("a tug",)})

    plant = RecordingPlant(Eventful())
    plant.reset(1)
    plant.command(torch.tensor(1))
    plant.observe()  # belongs to an earlier grasp
    plant.reset(6)
    plant.command(torch.tensor(1))
    plant.plant.count += 10  # another reading
    seen = plant.observe()
    kept = plant.trajectory.observations
    assert [int(o.q[0]) for o in kept] == [6, 17]
    assert len(plant.trajectory.commands) == 1
    assert kept[-1].info["events"] == seen.info["events"] == ("a tug",)


def test_what_is_recorded_in_mid_grasp_can_be_replayed() -> None:
    inner = Counter()
    inner.reset(3)
    plant = RecordingPlant(inner)
    plant.command(torch.tensor(2))
    assert [int(seen.q[0]) for seen in plant.trajectory.observations] == [3, 5]
    again = ReplayedPlant(plant.trajectory)
    assert int(again.observe().q[0]) == 3
    assert int(again.command(torch.tensor(2)).q[0]) == 5
    with pytest.raises(StateError, match="the recording ends after 1 commands"):
        again.command(torch.tensor(2))
    looked = RecordingPlant(inner)
    looked.observe()
    looked.observe()
    assert len(looked.trajectory.observations) == 1


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


Q = torch.zeros(2, dtype=torch.float64)
EYE = torch.eye(3, dtype=torch.float64)


def reading(time: float, pose: float | None = None) -> Observation:
    stamps = None if pose is None else Stamps(time, time, pose, time)
    return Observation(Q, Q, Q.new_zeros(3), EYE, time=time, stamps=stamps)


def test_all_readings_are_of_the_observations_time_unless_told() -> None:
    assert reading(3.0).taken == Stamps(3.0, 3.0, 3.0, 3.0)
    assert reading(3.0, 2.5).taken.pose == 2.5
    assert reading(3.0).dated
    assert reading(0.0, 0.0).dated
    assert not reading(0.0).dated


def test_the_mean_of_frames_is_no_newer_than_any_of_them() -> None:
    camera = ScriptedPlant(reading(5.0, pose) for pose in (4.9, 4.8, 5.0))
    seen = FramesAtRest(camera, 3).observe()
    assert seen.taken == Stamps(5.0, 5.0, 4.8, 5.0)


def test_a_recording_keeps_stamps_and_does_without(tmp_path) -> None:
    dated = Trajectory(1, [Q], [reading(1.0, 1.0), reading(2.0, 1.0)])
    kept = Trajectory.load(dated.save(tmp_path / "dated.h5"))
    assert [o.stamps for o in kept.observations] == [o.stamps for o in dated.observations]
    bare = dataclasses.replace(dated, observations=[reading(1.0), reading(2.0)])
    kept = Trajectory.load(bare.save(tmp_path / "bare.h5"))
    assert [o.stamps for o in kept.observations] == [None, None]
