"""The servo inverse against servos whose dead zone and bias are known."""

import math

import numpy as np
import pytest
import torch
from fakes import FakePlant
from test_plant_gate import DEG, EYE, HAND, ORIGIN, REACH

from torch_ekm.exceptions import NonFiniteError, ShapeError
from torch_ekm.kinematics import ServoModel
from torch_ekm.plant import Observation, ServoInverse


class Servos(FakePlant):
    """Three motors, ``w = D(v + b + fresh; d)``, clipped to their range."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.d, self.b = np.array([1.3, 0.4, 2.0]) * DEG, np.array([0.2, -0.3, 0.0]) * DEG
        self.fresh, self.blocked = 0.1 * DEG, np.zeros(3, bool)
        self.a = np.zeros(3)

    def observe(self) -> Observation:
        a = torch.from_numpy(self.a.copy())
        return Observation(a, a, ORIGIN, EYE, a)

    def move(self, delta_a: torch.Tensor) -> None:
        reach = REACH
        x = np.clip(self.a + delta_a.numpy(), -reach, reach) - self.a + self.b
        x = x + self.fresh * self.rng.uniform(-1, 1, 3)
        w = np.where(self.blocked, 0.0, x - np.clip(x, -self.d, self.d))
        self.a = np.clip(self.a + w, -reach, reach)


def moves(n: int, seed: int = 1, size: float = 2.0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return list(size * DEG * torch.randn(n, 3, generator=generator, dtype=torch.float64))


def practised(n: int, inner: Servos | None = None) -> tuple[ServoInverse, Servos]:
    """After so many motions."""
    inner = Servos() if inner is None else inner
    plant = ServoInverse(inner, HAND)
    plant.reset(0)
    for w in moves(n):
        plant.command(w)
    return plant, inner


def test_dead_zone_and_bias_are_found_within_their_standard_errors() -> None:
    plant, inner = practised(40)
    error = torch.stack([plant.servo.dead_zone, plant.servo.bias]) - torch.from_numpy(
        np.stack([inner.d, inner.b])
    )
    assert float(error.abs().max()) < 0.08 * DEG
    assert bool((error.abs() < 4 * plant.servo.standard_errors).all())
    assert bool((plant.servo.standard_errors < 0.05 * DEG).all())
    assert torch.allclose(plant.servo.noise_std, torch.full((3,), 0.1 * DEG / 3**0.5).double(), rtol=0.4)
    assert "thumb: d=1.3" in repr(plant.servo)
    seen = plant.observe()
    for w in moves(60, seed=2, size=0.6):  # then the encoders do what is wanted, in both directions
        after = plant.command(w)
        wanted = torch.where(w.abs() > plant.servo.resolution, w, 0 * w)
        assert float((after.a - seen.a - wanted).abs().max()) < 0.25 * DEG
        seen = after


def test_a_small_error_is_no_rest_point_and_nothing_winds_up_on_reversal() -> None:
    """From nothing known: wishes of 0.3 deg soon move a servo with a dead zone of 1.3 deg, and back, too."""
    plant = ServoInverse(Servos(), HAND)
    seen = plant.reset(0)
    wish = torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64) * DEG
    for _ in range(8):
        after = plant.command(wish)
        if after.a[0] != seen.a[0]:
            break
    assert after.a[0] > seen.a[0]
    back = plant.command(-wish)
    for _ in range(2):
        if back.a[0] != after.a[0]:
            break
        back = plant.command(-wish)
    assert -1.0 * DEG < back.a[0] - after.a[0] < 0


def test_a_servo_that_never_moves_is_named_and_not_wound_up() -> None:
    plant, inner = practised(30)
    known = plant.servo.estimate.clone()
    inner.blocked[1] = True
    for k in range(15):
        plant.command(torch.full((3,), (-1) ** k * 1.0 * DEG, dtype=torch.float64))
    assert plant.servo.stuck.tolist() == [name == "index" for name in plant.servo.names]
    assert float((plant.servo.estimate[1] - known[1]).abs().max()) == 0.0
    inner.blocked[1] = False
    before = plant.observe().a
    after = plant.command(torch.full((3,), 1.0 * DEG, dtype=torch.float64))
    assert not plant.servo.stuck.any()
    assert float((after.a - before - DEG).abs().max()) < 0.25 * DEG


def test_the_end_of_the_range_teaches_nothing() -> None:
    plant, _ = practised(30)
    known = plant.servo.estimate.clone()
    for _ in range(8):
        plant.command(torch.full((3,), 15 * DEG, dtype=torch.float64))
    at_end = {k: v.clone() for k, v in plant.servo.state_dict().items()}
    for _ in range(10):
        plant.command(5 * DEG * torch.ones(3, dtype=torch.float64))
    assert not plant.servo.stuck.any()
    assert all(torch.equal(v, at_end[k]) for k, v in plant.servo.state_dict().items())
    assert float((plant.servo.estimate - known).abs().max()) < 0.05 * DEG


@pytest.mark.parametrize("side", [-1, 1])
def test_a_dead_zone_is_learned_at_the_end_of_the_range_too(side: int) -> None:
    """A motor that does not leave it when told to has a dead zone: the end is no obstacle to that motion."""
    inner = Servos()
    plant = ServoInverse(inner, HAND)
    inner.a[:] = side * REACH
    plant.reset(0)
    wish = torch.full((3,), -side * 0.5 * DEG, dtype=torch.float64)
    for _ in range(12):
        plant.command(wish)
    assert bool((np.abs(inner.a) < REACH - 0.3 * DEG).all())


def test_a_motion_that_begins_outside_the_range_teaches_nothing() -> None:
    """The controller of the motors brings it back by more than it was told."""
    inner = Servos()
    plant = ServoInverse(inner, HAND)
    inner.a[:] = REACH + 3 * DEG
    plant.reset(0)
    before = {k: v.clone() for k, v in plant.servo.state_dict().items()}
    plant.command(torch.full((3,), -4 * DEG, dtype=torch.float64))
    assert all(torch.equal(v, before[k]) for k, v in plant.servo.state_dict().items())


def test_set_points_stay_in_the_range() -> None:
    class Watched(Servos):
        def command(self, delta_a: torch.Tensor) -> Observation:
            goals.append(self.a + delta_a.numpy())
            return super().command(delta_a)

    goals: list[np.ndarray] = []
    plant, inner = practised(10, Watched())
    inner.a[:] = REACH * [1, -1, 1] - [0.5 * DEG, -0.5 * DEG, -0.1 * DEG]  # the last one is read beyond it
    plant.reset(0)
    goals.clear()
    plant.command(torch.tensor([1.0, -1.0, 0.0]).double() * DEG)  # dead zones would take it farther
    assert np.allclose(goals[0], [REACH[0], -REACH[1], REACH[2] + 0.1 * DEG], rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [0.2, 2.5])
def test_a_repaired_servo_is_found_again(scale: float) -> None:
    plant, inner = practised(60)
    inner.d = scale * inner.d
    for w in moves(12, seed=3):
        plant.command(w)
    assert float((plant.servo.dead_zone - torch.from_numpy(inner.d)).abs().max()) < 0.25 * DEG
    assert not plant.servo.stuck.any()


def test_readings_that_no_dead_zone_explains_are_undone_by_what_was_learned_of_them() -> None:
    """Frozen encoders once taught d = -5, b = -6.4 deg: the inverse without d went 5 deg too far."""
    servo = ServoModel(("thumb", "index"))
    for size in (8.0, 9.0, 7.0, 8.0, 9.0):  # two degrees farther than told, in one direction
        v = torch.tensor([size, -size]).double() * DEG
        servo.update(v, v + torch.tensor([2.0, -2.0]).double() * DEG)
    assert bool((servo.estimate[:, 0] < -1 * DEG).all())  # more of it than of b, whose prior is narrower
    assert not bool(servo.dead_zone.any())
    wanted = torch.tensor([6.0, -6.0]).double() * DEG
    assert torch.allclose(servo.command(wanted), wanted - wanted.sign() * 2 * DEG, rtol=0, atol=0.1 * DEG)


@pytest.mark.usefixtures("unchecked")
def test_bad_input_changes_nothing_and_a_state_dict_carries_all() -> None:
    plant, _ = practised(5)
    kept = {k: v.clone() for k, v in plant.servo.state_dict().items()}
    with pytest.raises(ShapeError):
        plant.servo.update(torch.zeros(2), torch.zeros(3))
    with pytest.raises(NonFiniteError):
        plant.servo.update(torch.zeros(3), torch.tensor([0.0, math.nan, 0.0]))
    assert all(torch.equal(v, kept[k]) for k, v in plant.servo.state_dict().items())
    other = ServoModel(plant.servo.names)
    other.load_state_dict(kept)
    v, w = moves(2)
    other.update(v, w)
    plant.servo.update(v, w)
    assert torch.equal(other.estimate, plant.servo.estimate)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("delta_a", "error"),
    [([math.nan] * 3, NonFiniteError), ([0.1], ShapeError), ([0.1] * 4, ShapeError), (0.1, ShapeError)],
)
def test_a_wrong_increment_moves_nothing(delta_a, error: type[Exception]) -> None:
    servos = Servos()
    plant = ServoInverse(servos, HAND)
    before = {name: value.clone() for name, value in plant.servo.named_buffers()}
    with pytest.raises(error, match="delta_a"):
        plant.command(torch.tensor(delta_a, dtype=torch.float64))
    assert not servos.a.any()
    assert all(torch.equal(value, before[name]) for name, value in plant.servo.named_buffers())
