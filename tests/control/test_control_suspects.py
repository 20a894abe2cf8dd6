"""Where the model refuses a state, the sensors that contradict each other are named."""

import dataclasses
import math

import pytest
import torch
from obedient_plant import Fault, Obedient, one_more, untaught

from torch_ekm.control import Guards, HandKnowledge, Manipulation, PoseTarget, Safety, StoppingRule
from torch_ekm.control import StopReason as Reason
from torch_ekm.control.watch import Watch
from torch_ekm.plant import Observation

DEG = math.pi / 180


def watch_of(model) -> Watch:
    return Watch(Guards(), model, HandKnowledge.of(model.hand, learns=False))


def run(held, fault: Fault, since: int) -> Manipulation:
    seen, axis, _ = held
    loop = untaught(held, fault, since=since, safety=Safety(rule=StoppingRule(max_steps=25)))
    return loop.run(PoseTarget.turned(seen.state, axis, degrees=12))


OFF = {  # 8 mm, 17 deg: less than what is called a jump
    "pose": (one_more("position", 0, 0.008), "the object went along x", "fingertips press ("),
    "joint": (one_more("q", 6, -17 * DEG), "joint 'index_2' turned", "fingertips press (index)"),
}  # fmt: skip


@pytest.mark.parametrize("sensor", OFF)
@pytest.mark.parametrize("since", [0, 2])
def test_a_sensor_that_is_off_is_named(held, sensor, since) -> None:
    fault, went, contradicts = OFF[sensor]
    done = run(held, fault, since)
    assert done.reason is Reason.UNSTABLE_GRASP
    assert contradicts in done.stop.message
    assert "check these sensors" in done.stop.message
    assert (went in done.stop.message) is (since > 0)
    joints = "encoder 'index_distal' and its joints (index_2, index_3) differ" in done.stop.message
    assert joints is (sensor == "joint" and since > 0)  # in the first reading it may be moment arms


def test_moment_arms_that_are_not_as_described_are_no_fault_of_a_sensor(held) -> None:
    seen, _, model = held
    watch = watch_of(model)
    watch.first(seen, lambda: seen)
    J_a = model.hand.actuation_jacobian
    turned = 30 * DEG * (J_a[model.hand.actuator_names.index("index_distal")] > 0)
    way = J_a @ turned
    for arms, blamed in ((1.0, False), (1.3, False), (2.5, True)):
        q, a = seen.q + torch.from_numpy(turned), seen.a + torch.from_numpy(arms * way)
        assert ("'index_distal'" in watch.suspects(dataclasses.replace(seen, q=q, a=a))) is blamed


def test_fingertips_that_read_too_little_are_told_until_they_are_known_to(held) -> None:
    """On a hand of which nothing is known it may be the springs: it is told, and learned. After healthy turns
    it is a fault, of which nothing is learned, until it has lasted for some grasps."""
    seen, axis, model = held
    knowledge = HandKnowledge.of(model.hand)

    def turned(scale: float) -> Manipulation:
        def scaled(plant: Obedient, seen: Observation) -> Observation:
            return dataclasses.replace(seen, fingertip_force=scale * seen.fingertip_force)

        loop = untaught(held, scaled, since=0, knowledge=knowledge)
        return loop.run(PoseTarget.turned(seen.state, axis, degrees=4))

    known, told = [], []
    for scale in (0.4, 0.4, *[1.0] * 8, 0.4):
        before = knowledge.forces.theta.clone()
        done = turned(scale)
        assert done.reason is Reason.REACHED
        known.append(knowledge.forces.usual)
        learned = not torch.equal(knowledge.forces.theta, before)
        told.append((("check their scale" in done.stop.message), learned))
    assert told[:2] == [(True, True), (False, True)]
    assert known[1] == pytest.approx(0.4, abs=0.1)
    assert told[2] == (True, False)
    assert told[8:10] == [(False, True)] * 2
    assert told[10] == (True, False)


def test_readings_without_a_date_are_told_once(held) -> None:
    """Nothing ends: readings that repeat bit by bit still show."""
    done = run(held, lambda plant, seen: dataclasses.replace(seen, time=0.0, stamps=None), since=0)
    assert done.reason is Reason.REACHED
    told = [k for k, step in enumerate(done.steps) if "Observation.time" in step.note]
    assert told == [0]


@pytest.mark.parametrize(("by_joints", "told"), [(0.4, False), (1.5, True), (3.0, False), (9.0, True)])
def test_joints_that_say_nothing_of_forces_do_not_contradict_the_fingertips(
    held, monkeypatch, by_joints, told
):
    """Joints without springs behind rigid motors give next to nothing, whatever the pads press with."""
    tests = watch_of(held[2]).fingertips
    monkeypatch.setattr(tests, "_by_joints", lambda seen: {0: by_joints, 1: by_joints})
    assert bool(tests._scale(held[0], torch.full((5,), 4.0, dtype=torch.float64))) is told
