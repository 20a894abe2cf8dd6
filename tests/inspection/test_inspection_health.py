"""Which actuator changed, from motions that are made up; benchmarks/hand_health.py has simulated ones."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.description import load_hand
from torch_ekm.exceptions import StateError
from torch_ekm.inspection.health import hand_health
from torch_ekm.kinematics import ActuationMap
from torch_ekm.plant import Observation, PlantStatus, Trajectory, TrialLog

DEG = math.pi / 180
HAND = load_hand("yale_t42")
DRIVES = tuple(dataclasses.replace(one, stiffness=math.inf, tendon=False) for one in HAND.actuators)


class Made:
    """Motions of a T42: what tendons pass on, how far joints go by themselves, and dead zones, as set."""

    def __init__(self, seed: int) -> None:
        self.draw, self.map = (
            np.random.default_rng(seed),
            ActuationMap(dataclasses.replace(HAND, actuators=DRIVES)),
        )
        self.gain, self.dead = np.array([0.6, 0.7]), np.array([1.0, 1.0]) * DEG
        self.a = np.array([0.9, 0.8])
        self.x = self.a.copy()
        self.log = Trajectory(seed, [], [self.look()])

    def look(self, status: PlantStatus = PlantStatus.HELD) -> Observation:
        q = self.map.joints(torch.from_numpy(self.x)) + torch.from_numpy(self.draw.normal(0, 0.3 * DEG, 4))
        return Observation(q, torch.from_numpy(self.a.copy()), torch.zeros(3).double(), torch.eye(3).double(),
                           None, status=status)  # fmt: skip

    def move(
        self, n: int = 1, gave: tuple = (0.0, 0.0), status: PlantStatus = PlantStatus.HELD, size: float = 2.5
    ) -> None:
        for _ in range(n):
            v = self.draw.normal(0, size * DEG, 2) - 0.3 * (self.a - [0.9, 0.8])
            error = v + self.draw.normal(0, 0.05 * DEG, 2)
            w = error - np.clip(error, -self.dead, self.dead)
            self.a, self.x = self.a + w, self.x + self.gain * w + np.array(gave) * DEG
            self.log.commands.append(torch.from_numpy(v))
            self.log.observations.append(self.look(status))


def test_healthy_hands_are_left_alone() -> None:
    changes = []
    for seed in range(4):
        made = Made(seed)
        made.move(250)
        changes += hand_health(HAND, [(0, made.log)])
    assert changes == []


@pytest.mark.parametrize("seed", range(4))
def test_motors_that_begin_within_their_dead_zone_have_not_changed(seed: int) -> None:
    made = Made(seed)
    made.dead[:] = 1.5 * DEG
    made.move(25, size=0.3)  # a motor that stands shows a bound of its dead zone alone
    made.move(60)
    assert hand_health(HAND, [(0, made.log)]) == []


@pytest.mark.parametrize("seed", range(8))
def test_a_tendon_that_breaks_is_named_at_once(seed: int) -> None:
    made, motor = Made(seed), seed % 2
    made.move(30)
    made.gain[motor] = 0.0
    made.move(gave=(-30.0 * (motor == 0), -30.0 * (motor == 1)))
    made.move(14)
    made.log.observations[5].q[:] = math.nan  # sensors that were silent once
    (change,) = hand_health(HAND, [(7, made.log)])
    assert change[:4] == (("left", "right")[motor], "tendon", 7, 30)
    went = re.match(r"its joints went (-\d+\.\d) deg by themselves", change.found)
    assert float(went[1]) == pytest.approx(-30, abs=5)
    assert change.found.endswith("broken, slipped, or off its pulley")


@pytest.mark.parametrize("seed", range(2))
def test_one_glitch_of_one_joint_sensor_is_no_change(seed: int) -> None:
    made = Made(seed)
    made.move(30)
    first = made.log
    made.log = Trajectory(seed, [], [made.look()])  # a second trial: no motion leads from frame 30 to it
    made.move(15)
    trials = [(0, first), (1, made.log)]
    frames = [*first.observations, *made.log.observations]
    for k in (3, 11, 12, 13, 20, 29, 30, 31, 40):
        for degrees in (8.0, -25.0, 60.0):
            frames[k].q[seed] += degrees * DEG
            assert hand_health(HAND, trials) == [], (k, degrees)
            frames[k].q[seed] -= degrees * DEG


def test_what_the_last_motion_alone_says_is_to_be_confirmed() -> None:
    made = Made(0)
    made.move(30)
    made.move(gave=(0.0, -30.0))
    (change,) = hand_health(HAND, [(0, made.log)])
    assert change[:4] == ("right", "tendon", 0, 30)
    assert change.found.endswith("in the last motion: another must confirm it")
    made.gain[1] = 0.0
    made.move(2)
    (change,) = hand_health(HAND, [(0, made.log)])
    assert change.motion == 30
    assert "confirm" not in change.found


def test_a_tendon_that_lets_go_unloaded_shows_by_what_it_passes_on() -> None:
    made = Made(0)
    made.move(40)
    made.gain[1] = 0.0
    made.move(40)
    (change,) = hand_health(HAND, [(0, made.log)])
    assert (change.actuator, change.part) == ("right", "tendon")
    assert 38 <= change.motion <= 45
    assert re.search(r"passes on -?0.0\d .* was 0.[567]", change.found)


def test_a_dead_zone_that_grew() -> None:
    made = Made(3)
    made.move(40)
    made.dead[0] = 2.0 * DEG
    later = Made(4)
    later.dead[0] = 2.0 * DEG
    later.move(40)
    (change,) = hand_health(HAND, [(3, made.log), (4, later.log)])
    assert change[:3] == ("left", "servo", 4)
    assert change.motion <= 4
    assert change.found.startswith(("dead zone 1.9", "dead zone 2.0"))
    assert "was 1.0" in change.found or "was 0.9" in change.found


def test_tendons_that_give_way_when_the_object_is_lost_are_no_change() -> None:
    made = Made(0)
    made.move(30)
    made.move(gave=(11.0, 9.0), status=PlantStatus.LOST)
    made.move(10, status=PlantStatus.LOST)
    assert hand_health(HAND, [(0, made.log)]) == []
    made = Made(0)
    made.move(30)
    made.move(gave=(-45.0, 9.0), status=PlantStatus.LOST)
    assert [one.actuator for one in hand_health(HAND, [(0, made.log)])] == ["left"]


def test_a_log_of_another_hand_is_refused() -> None:
    made = Made(0)
    made.move(2)
    with pytest.raises(StateError, match=r"trial 5.*4 joints and 2 actuators.*'icub_right'"):
        hand_health(load_hand("icub_right"), [(5, made.log)])


def test_the_command_reads_logs(tmp_path: Path, monkeypatch) -> None:
    def health(*names: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["health", *names])
        return done.exit_code, done.output.partition("Next:")[0] or str(done.exception)

    def kept(name: str, made: Made, *more: Trajectory, hand: str = "yale_t42") -> None:
        with TrialLog(name, {"hand": hand} if hand else {}) as log:
            for trial, one in enumerate((made.log, *more)):
                log.write(trial, one, {})

    monkeypatch.chdir(tmp_path)
    sound, early, later = Made(1), Made(1), Made(2)
    sound.move(30)
    early.move(6)
    later.move(5)
    later.move(gave=(0.0, 25.0))
    kept("sound", sound, Trajectory(1))
    kept("early", early)
    kept("later", later, hand="")
    assert health("sound") == (0, "No actuator changed in 30 motions.\n")
    few = "No actuator changed in 6 motions. An actuator is judged after 12 motions.\n"
    assert health("early") == (0, few)
    code, said = health("sound", "later")
    assert code == 1
    assert "right" in said
    assert "tendon" in said
    code, said = health("later")
    assert code == 1
    assert "--hand NAME" in said


def test_a_joint_that_is_never_read_is_said_and_the_other_tendons_are_watched() -> None:
    made = Made(0)
    made.move(30)
    made.gain[1] = 0.0
    made.move(gave=(0.0, -30.0))
    made.move(14)
    made.log.observations[10].q[2] = 1e300
    for seen in made.log.observations:
        seen.q[0] = math.nan
    with pytest.warns(UserWarning, match="joints of left were never read"):
        (found,) = hand_health(HAND, [(0, made.log)])
    assert (found.actuator, found.part, found.motion) == ("right", "tendon", 30)
