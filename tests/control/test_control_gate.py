"""What a loop sends to its plant, learns, and says, when readings lie, and when it is not alone."""

import concurrent.futures
import copy
import dataclasses
import math
import re
import threading
from collections.abc import Callable
from pathlib import Path

import killed_turns
import pytest
import torch
from light_plant import Fault, Obedient

from torch_ekm.control import (
    ClosedLoop,
    Guards,
    HandKnowledge,
    Journal,
    LookAndMoveController,
    Manipulation,
    OneStep,
    PoseTarget,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import (
    CommandRefusedError,
    FileFormatError,
    OutputError,
    PlantInUseError,
    ResumeError,
    StateMismatchError,
)
from torch_ekm.plant import Observation, PlantStatus, PlantWrapper
from torch_ekm.residual import RecursiveLeastSquares
from torch_ekm.residual import files as learner_files

DEG = math.pi / 180


def loop_of(held, plant, learns: bool = True, **options) -> ClosedLoop:
    seen, axis, model = held
    chosen = EnhancedModel.for_grasp(model, seen.state) if learns else model
    # in small steps, whatever a planner makes of a hand that it knows
    return ClosedLoop(plant, LookAndMoveController(chosen, axis), **{"planner": OneStep(), **options})


def turn(held, plant, angle: float = 20.0, learns: bool = True, **options) -> tuple[ClosedLoop, Manipulation]:
    seen, axis, _ = held
    loop = loop_of(held, plant, learns, **options)
    return loop, loop.run(PoseTarget.turned(seen.state, axis, degrees=angle))


# -- what is refused is seen by nobody ---------------------------------------------------------------------


def test_a_hand_that_is_well_again_turns_whatever_was_believed_of_its_servos(held) -> None:
    for bias in (-3.0, 0.42, 3.0):
        knowledge = HandKnowledge.of(held[2].hand)
        knowledge.servo.estimate[3, 1] = bias
        knowledge.servo.covariance[3] *= 1e-3
        reasons = []
        for _ in range(2):
            plant = Obedient(held[2], held[0])
            reasons.append(turn(held, plant, 10.0, knowledge=knowledge)[1].reason)
            assert max(float(v.abs().max()) for v in plant.given) <= Guards().increment
        assert reasons[-1] is Reason.REACHED, (bias, reasons)
        assert float(knowledge.servo.bias.abs().max()) < 0.5 * DEG


def test_an_encoder_that_jumps_is_found_out_where_the_camera_sees_nothing(held) -> None:
    def blind(plant: Obedient, seen: Observation) -> Observation:
        if len(plant.given) != 2:
            return seen
        return dataclasses.replace(seen, a=seen.a + 0.3 * third(seen.a), status=PlantStatus.NOT_SEEN)

    done = turn(held, Obedient(held[2], held[0], blind))[1]
    assert done.reason is Reason.ENCODER_JUMP
    assert len(done.steps) == 2  # at once: no motion starts from there


def test_a_command_that_the_gate_refuses_ends_the_turn_with_its_steps(held) -> None:
    knowledge = HandKnowledge.of(held[2].hand)
    plant = Obedient(held[2], held[0])
    loop = loop_of(held, plant, knowledge=knowledge)
    steps, motions = [], loop.steps(PoseTarget.turned(held[0].state, held[1], degrees=20))
    steps.append(next(motions))
    knowledge.servo.estimate.fill_(math.nan)
    with pytest.raises(StopIteration) as end:
        next(motions)
    stop = end.value.value
    assert stop.reason is Reason.COMMAND_REFUSED
    assert isinstance(stop.cause, CommandRefusedError)
    assert stop.cause.by == "turn"
    assert "nan deg" in stop.cause.asked
    assert torch.equal(stop.final.q, steps[0].after.q)
    assert not bool(plant.given[-1].any())  # it holds
    assert all(bool(v.isfinite().all()) for v in plant.given)


# -- one master --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("same_loop", [True, False])
def test_a_second_turn_at_the_same_time_is_refused(held, same_loop: bool) -> None:
    seen, axis, model = held
    under_way, go_on = threading.Event(), threading.Event()

    def wait(plant: Obedient, now: Observation) -> Observation:
        under_way.set()
        assert go_on.wait(60)
        return now

    plant = Obedient(model, seen, wait, since=1)
    loop = loop_of(held, plant, learns=False)
    other = loop if same_loop else loop_of(held, PlantWrapper(plant), learns=False)
    target = PoseTarget.turned(seen.state, axis, degrees=5)
    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        first = thread.submit(loop.run, target)
        assert under_way.wait(60)
        with pytest.raises(PlantInUseError):
            other.run(target)
        go_on.set()
        assert first.result(60).reason is Reason.REACHED
    assert other.run(target).reason is Reason.REACHED  # now it is free


# -- sensors that lie --------------------------------------------------------------------------------------


class Reversed(Obedient):
    """All motors go the other way; ``seen`` by their encoders or not."""

    shown = True

    def command(self, delta_a: torch.Tensor) -> Observation:
        return super().command(-delta_a)

    def observe(self) -> Observation:
        seen = super().observe()
        return seen if self.shown else dataclasses.replace(seen, a=2 * self.start.a - seen.a)


class Hidden(Reversed):
    shown = False


def changed(**fields: Callable[[int, torch.Tensor], torch.Tensor]) -> Fault:
    """Fields of a reading after k commands."""
    return lambda plant, seen: dataclasses.replace(
        seen, **{name: change(len(plant.given), getattr(seen, name)) for name, change in fields.items()}
    )


def third(x: torch.Tensor) -> torch.Tensor:
    return torch.arange(len(x)) == 3


LIES = {
    "fingertips read half": (
        Obedient, changed(fingertip_force=lambda k, f: f / 2), None, "joints and springs give", "scale"),
    "fingertips read half from the middle on": (
        Obedient, changed(fingertip_force=lambda k, f: f / (1 + (k > 2))), None, "joints and springs give",
        "scale"),
    "motors reversed, encoders too": (
        Reversed, None, Reason.WRONG_WAY, "encoders made -", "torch-ekm check --plant"),
    "motors reversed, encoders as told": (
        Hidden, None, Reason.WRONG_WAY, "joints and object made -", "torch-ekm check --plant"),
    "joints 3 deg too far": (
        Obedient, changed(q=lambda k, q: q + 3 * DEG), Reason.UNSTABLE_GRASP, "fingertips press (",
        "zero"),
    "joints 3 deg too little": (
        Obedient, changed(q=lambda k, q: q - 3 * DEG), Reason.UNSTABLE_GRASP, "fingertips press (",
        "zero"),
    "joints 3 deg too far from the middle on": (
        Obedient, changed(q=lambda k, q: q + 3 * DEG * (k > 2)), Reason.UNSTABLE_GRASP,
        "fingertips press (", "zero"),
    "encoders drift": (
        Obedient, changed(a=lambda k, a: a + k * DEG), Reason.ENCODER_DRIFT, "sent nowhere", "magnet"),
}  # fmt: skip


@pytest.fixture(scope="module")
def taught(held):
    """A learner and knowledge of the hand after three turns, and the error of clean turns with them [deg]."""
    knowledge, ekm = HandKnowledge.of(held[2].hand), EnhancedModel.for_grasp(held[2], held[0].state)
    for angle in (20.0, -12.0, 15.0):
        controller, plant = (
            LookAndMoveController(ekm, held[1]),
            Obedient(held[2], held[0], dead_zone=1.3 * DEG),
        )
        ClosedLoop(plant, controller, knowledge=knowledge).run(
            PoseTarget.turned(held[0].state, held[1], degrees=angle)
        )
    return ekm, knowledge, error_of_a_clean_turn(held, ekm, knowledge)


def error_of_a_clean_turn(held, ekm: EnhancedModel, knowledge: HandKnowledge) -> float:
    """Largest rotation of a movement that f + g did not predict [deg]."""
    plant, off = Obedient(held[2], held[0], dead_zone=1.3 * DEG, noise=1e-6), []
    controller = LookAndMoveController(ekm, held[1])
    loop = ClosedLoop(plant, controller, knowledge=copy.deepcopy(knowledge), learn=False)
    for step in loop.run(PoseTarget.turned(held[0].state, held[1], degrees=15)).steps:
        expected = controller.expect(step.decision.pieces, step.after.a - step.before.a)
        off.append((expected.increment - step.increment)[-3:])
    return max(float(rotation.norm()) for rotation in off) / DEG


@pytest.mark.parametrize(
    ("lie", "whole"), [*((lie, False) for lie in LIES), ("motors reversed, encoders too", True)]
)
def test_a_sensor_that_lies_is_named_and_teaches_nothing(held, taught, lie: str, whole: bool) -> None:
    kind, fault, reason, what, remedy = LIES[lie]
    ekm, knowledge, before = copy.deepcopy(taught)
    plant = kind(held[2], held[0], fault, since=0, dead_zone=1.3 * DEG)
    controller = LookAndMoveController(ekm, held[1])
    loop = ClosedLoop(plant, controller, knowledge=knowledge, planner=None if whole else OneStep())
    known = knowledge.servo.estimate.clone()
    done = loop.run(PoseTarget.turned(held[0].state, held[1], degrees=20))
    assert done.reason is (reason or done.reason)
    assert what in done.stop.message
    assert remedy in done.stop.message
    assert re.search("limit|allowed|Guards", done.stop.message)
    if reason is Reason.WRONG_WAY:
        assert len(done.steps) <= 2
    if lie.endswith("from the middle on"):
        assert torch.equal(knowledge.servo.estimate, known)
    assert error_of_a_clean_turn(held, ekm, knowledge) < 1.1 * before


@pytest.mark.parametrize("learns", [True, False])
def test_of_a_hand_that_is_well_nothing_is_said(held, learns: bool) -> None:
    for angle in (20.0, -12.0):
        plant = Obedient(held[2], held[0], dead_zone=1.3 * DEG)
        known = HandKnowledge.of(held[2].hand)
        _, done = turn(held, plant, angle, learns, knowledge=known, planner=None)
        assert not done.stop.message
        assert not any(step.note for step in done.steps)


# -- a process that is killed ------------------------------------------------------------------------------


@pytest.mark.parametrize(("moment", "learns"), [(0.0, False), (0.12, True), (0.3, False)])
def test_a_turn_that_was_killed_is_gone_on_with(tmp_path: Path, moment: float, learns: bool) -> None:
    with killed_turns.here("light") as hand:
        _, end = killed_turns.killed(hand, moment, learns, tmp_path, 1.0)
    assert end in killed_turns.RIGHT
    assert Journal(tmp_path / "turn.ekm").cut_short is False


def journal_of(held, tmp_path: Path) -> tuple[Journal, ClosedLoop]:
    """Of a turn that was left after two motions."""
    plant = Obedient(held[2], held[0])
    loop, journal = loop_of(held, plant), Journal(tmp_path / "turn.ekm")
    motions = journal.steps(loop, PoseTarget.turned(held[0].state, held[1], degrees=20))
    next(motions)
    next(motions)
    motions.close()
    assert journal.cut_short
    return journal, loop


def test_what_was_learned_until_the_last_motion_is_there_and_the_hand_holds_first(held, tmp_path) -> None:
    journal, loop = journal_of(held, tmp_path)
    again = loop_of(held, loop.plant.plant.plant)  # the plant behind inverse and gate
    again.plant.given.clear()
    result = journal.resume(again)
    assert result.reason is Reason.REACHED
    assert not bool(again.plant.given[0].any())
    assert torch.equal(result.steps[0].before.a, again.plant.true[-len(result.steps)])
    assert int(again.knowledge.figures.count) == int(loop.knowledge.figures.count) + len(result.steps)
    with pytest.raises(ResumeError, match="came to its end: reached"):
        journal.resume(again)


WHY_NOT = {
    "moved": (lambda plant: setattr(plant, "a", plant.a + 69 * DEG), "stands 69 deg from where it was"),
    "lost": (lambda plant: vars(plant).update(fault=lost, since=0), "the object is lost"),
    "taken": (lambda plant: setattr(plant, "state", shifted(plant.state)), "173 mm and"),
}


def lost(plant: Obedient, seen: Observation) -> Observation:
    return dataclasses.replace(seen, status=PlantStatus.LOST)


def shifted(state):
    return dataclasses.replace(state, position=state.position + 0.1)


@pytest.mark.parametrize("name", WHY_NOT)
def test_a_turn_that_cannot_be_gone_on_with_is_refused_and_nothing_is_taken_over(held, tmp_path, name):
    journal, loop = journal_of(held, tmp_path)
    plant = loop.plant.plant.plant
    WHY_NOT[name][0](plant)
    again = loop_of(held, plant)
    plant.given.clear()
    with pytest.raises(ResumeError, match=WHY_NOT[name][1]):
        journal.resume(again)
    assert [bool(v.any()) for v in plant.given] == [False]
    assert int(again.knowledge.figures.count) == 0


def test_what_another_learner_learned_is_refused_and_nothing_of_the_rest_is_taken_over(held, tmp_path):
    journal, loop = journal_of(held, tmp_path)
    ekm = EnhancedModel.for_grasp(held[2], held[0].state, RecursiveLeastSquares(26, 6))
    again = ClosedLoop(loop.plant.plant.plant, LookAndMoveController(ekm, held[1]))
    before = copy.deepcopy(again.learned.state_dict())
    with pytest.raises(StateMismatchError):
        journal.resume(again)
    after = again.learned.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items() if "knowledge" in name)


def edited(path: Path, change) -> None:
    """As another version of the package would have written the journal."""
    described, state = learner_files.read(path)
    change(described, state)
    learner_files.write(path, described, state)


OTHERS = {
    "no actuators": lambda described, state: state.pop("actuators"),
    "no encoders": lambda described, state: state["seen"].pop("a"),
    "target is a number": lambda described, state: state["target"].update(position=torch.zeros(())),
    "NaN in the target": lambda described, state: state["target"]["position"].fill_(math.nan),
    "of another kind": lambda described, state: described.update({"class": "HandKnowledge"}),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_journal_of_another_version_is_refused_and_nothing_is_taken_over(held, tmp_path, name) -> None:
    journal, loop = journal_of(held, tmp_path)
    again = loop_of(held, loop.plant.plant.plant)
    before = {k: v.clone() for k, v in again.learned.state_dict().items() if isinstance(v, torch.Tensor)}
    edited(journal.path, OTHERS[name])
    with pytest.raises(FileFormatError, match="no journal of a turn"):
        _ = journal.cut_short
    with pytest.raises(FileFormatError, match="no journal of a turn"):
        journal.resume(again)
    assert all(torch.equal(again.learned.state_dict()[k], v) for k, v in before.items())


def test_a_file_that_is_no_journal_is_neither_read_nor_written_over(held, tmp_path) -> None:
    """What was learned of the hand is in such a file, too."""
    loop, path = loop_of(held, Obedient(held[2], held[0])), tmp_path / "hand.ekm"
    with pytest.raises(ResumeError, match="no such file"):
        Journal(path).resume(loop)
    loop.knowledge.save(path)
    kept = path.read_bytes()
    with pytest.raises(FileFormatError, match="no journal"):
        Journal(path).resume(loop)
    with pytest.raises(FileFormatError, match="no journal of a turn"):
        Journal(path).run(loop, PoseTarget.turned(held[0].state, held[1], degrees=20))
    assert path.read_bytes() == kept
    assert not any(bool(v.any()) for v in loop.plant.plant.plant.given)  # it has held, where it was


def test_two_turns_do_not_share_a_journal(held, tmp_path) -> None:
    """The one that began first would lose its target and what it has learned."""
    target, path = PoseTarget.turned(held[0].state, held[1], degrees=20), tmp_path / "turn.ekm"
    first, second = (Journal(path).steps(loop_of(held, Obedient(held[2], held[0])), target) for _ in range(2))
    next(first)
    next(second)
    with pytest.raises(OutputError, match="another turn is written there"):
        next(first)
    next(second)
