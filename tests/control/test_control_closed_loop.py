"""The closed loop on plants that misbehave."""

import dataclasses
import math
import threading

import pytest
import torch
from fakes import FakePlant
from obedient_plant import watched

from torch_ekm.control import (
    ClosedLoop,
    HandKnowledge,
    LookAndMoveController,
    OneStep,
    PoseTarget,
    Safety,
    StoppingRule,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.control.program import ControlProblem
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError, ParameterError, SolverError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation, Plant, PlantStatus

DEG = math.pi / 180
RULE = StoppingRule(tolerance=0.25 * DEG, stall_window=3, stall_progress=0.1 * DEG, max_steps=5)
SAFETY = Safety(rule=RULE)


class FrozenPlant(FakePlant):
    """Never moves, as a hand whose motors have lost their power; its clock goes on, its sensors are alive.
    What it reports can be changed from some command on."""

    def __init__(self, observation: Observation, change=None, after: int = 2) -> None:
        super().__init__()
        self.observation, self.change, self.after = observation, change, after
        self.commands = self.looks = 0

    def reset(self, seed: int) -> Observation:
        return self.observation

    def observe(self) -> Observation:
        time = self.observation.time + self.commands
        place = self.observation.position + 1e-9 * self.looks  # no two pictures are alike
        self.looks += 1
        seen = dataclasses.replace(self.observation, position=place, time=time, stamps=None)
        if self.change is not None and self.commands >= self.after:
            return self.change(seen)
        return seen

    def move(self, delta_a: torch.Tensor) -> None:
        self.commands += 1


@pytest.fixture(scope="module")
def held(pinch):
    plant, model, seen = pinch
    return seen, plant.rotation_axis, LookAndMoveController(model, plant.rotation_axis)


def drive(held, change=None, angle: float = 20.0, rule: StoppingRule = RULE):
    seen, axis, loop = held
    plant = FrozenPlant(seen, change)
    assert isinstance(plant, Plant)
    target = PoseTarget.turned(seen.state, axis, degrees=angle)
    return ClosedLoop(plant, loop, safety=Safety(rule=rule)).run(target), plant


@pytest.mark.parametrize(
    ("window", "motions", "reason"), [(3, 3, Reason.STALLED), (50, 5, Reason.STEP_LIMIT)]
)
def test_target_that_cannot_be_reached_stalls_and_says_so(held, window, motions, reason) -> None:
    done, plant = drive(held, rule=dataclasses.replace(RULE, stall_window=window))
    assert done.reason is reason
    assert done.errors[-1] == pytest.approx(20 * DEG)
    assert plant.commands == len(done.steps) == motions


@pytest.mark.parametrize(("angle", "looks"), [(0.01, 2), (0.2, 4)])
def test_target_that_is_reached_already_needs_no_command(held, angle, looks) -> None:
    """One look may be noise, and more are needed near the tolerance."""
    done, plant = drive(held, angle=angle)
    assert done.reason is Reason.REACHED
    assert (plant.commands, plant.looks) == (0, looks)


@pytest.mark.parametrize("solved", [0, 1, 2])
def test_a_program_that_no_solver_solves_gives_up_holding(held, monkeypatch, solved: int) -> None:
    """Next to buckling a Jacobian is out of all scale: the loop ends, and raises nothing."""
    solve, calls = ControlProblem.solve, []

    def no_longer(problem: ControlProblem):
        calls.append(problem)
        if len(calls) > solved:
            raise SolverError("piqp", "no solution found")
        return solve(problem)

    monkeypatch.setattr(ControlProblem, "solve", no_longer)
    done, _ = drive(held)
    assert done.reason is Reason.UNSTABLE_GRASP
    assert "no solution found" in done.stop.message
    assert len(done.steps) <= solved


def test_dislocation_counts_as_lost(held) -> None:
    across = torch.linalg.cross(held[1], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    across = across / torch.linalg.vector_norm(across)

    def dislocate(seen: Observation) -> Observation:
        return dataclasses.replace(seen, rotation=exp(20 * DEG * across) @ seen.rotation)

    done, _ = drive(held, dislocate, rule=dataclasses.replace(RULE, off_limit=15 * DEG))
    assert done.reason is Reason.OBJECT_LOST
    assert "dislocated" in done.stop.message


def test_object_out_of_reach_of_the_fingers_is_lost(held) -> None:
    """Where the fingertips feel that it is gone; else it is the camera that is wrong."""

    def away(seen: Observation, felt: float) -> Observation:
        force = felt * seen.fingertip_force
        return dataclasses.replace(seen, position=seen.position + 0.2, fingertip_force=force)

    done, _ = drive(held, lambda seen: away(seen, 0.0))
    assert done.reason is Reason.OBJECT_LOST
    assert "touches" in done.stop.message
    done, _ = drive(held, lambda seen: away(seen, 1.0))
    assert done.reason is Reason.POSE_JUMP


SPOILT = {
    "not finite": (
        "NonFiniteError: Observation.position",
        lambda seen: {"position": seen.position * math.nan},
    ),
    "one joint short": ("ShapeError: Observation.q must have shape (20,)", lambda seen: {"q": seen.q[:-1]}),
    "no rotation": ("ParameterError: rotation", lambda seen: {"rotation": 2 * seen.rotation}),
    "nothing": ("ParameterError: ", None),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("what", SPOILT)
def test_a_reading_that_is_none_ends_the_loop_with_its_steps_and_its_name(held, what: str) -> None:
    said, spoil = SPOILT[what]
    done, _ = drive(held, lambda seen: spoil and dataclasses.replace(seen, **spoil(seen)))
    assert done.reason is Reason.PLANT_FAILED
    assert isinstance(done.stop.cause, EKMError)
    assert repr(done).startswith(f"<Manipulation: plant failed after 1 motions: {said}")
    assert ("'icub_right'" in done.stop.message) is (what == "one joint short")
    assert ("must be an Observation" in done.stop.message) is (what == "nothing")


@pytest.mark.usefixtures("unchecked")
def test_swapped_arguments_and_angles_as_targets_are_refused(held) -> None:
    seen, _, loop = held
    with pytest.raises(ParameterError, match="a LookAndMoveController"):
        ClosedLoop(loop, FrozenPlant(seen))
    with pytest.raises(ParameterError, match=r"PoseTarget\.turned"):
        ClosedLoop(FrozenPlant(seen), loop).run(20.0)


def test_steps_are_a_generator_that_tells_why_it_ends(held) -> None:
    seen, axis, loop = held
    plant = FrozenPlant(seen)
    motions = ClosedLoop(plant, loop, safety=SAFETY).steps(PoseTarget.turned(seen.state, axis, degrees=20))
    first = next(motions)
    assert plant.commands == 1  # nothing runs ahead of its consumer
    assert first.before.q is seen.q
    assert first.report is None  # a kinematic model alone learns nothing
    torch.testing.assert_close(first.increment, torch.zeros_like(first.increment))
    assert len([next(motions) for _ in range(2)]) == 2
    with pytest.raises(StopIteration) as end:
        next(motions)
    assert end.value.value.reason is Reason.STALLED
    assert end.value.value.final.q is seen.q


def test_an_enhanced_model_learns_unless_seen_motions_not_to(held) -> None:
    seen, axis, loop = held
    target = PoseTarget.turned(seen.state, axis, degrees=20)
    for learn in (True, False):
        ekm = EnhancedModel.for_grasp(loop.kinematic, seen.state)
        controller = LookAndMoveController(ekm, axis)
        knowledge = HandKnowledge.of(loop.kinematic.hand, learns=False, adapts=False)  # from the commands
        options = {"knowledge": knowledge, "safety": SAFETY}
        driven = ClosedLoop(FrozenPlant(seen), controller, **options, learn=learn)
        steps = driven.run(target).steps
        assert [step.report is not None for step in steps][:2] == [learn] * 2
        da = steps[0].decision.delta_a
        untouched = torch.equal(ekm(seen.state, da), loop.kinematic(seen.state, da))
        assert untouched is not learn
        if learn:  # it saw that nothing moves: it asks for more
            assert steps[-1].decision.delta_a.norm() > 2 * steps[0].decision.delta_a.norm()


def test_an_object_that_is_lost_teaches_nothing(held) -> None:
    seen, axis, loop = held
    controller = LookAndMoveController(EnhancedModel.for_grasp(loop.kinematic, seen.state), axis)
    plant = FrozenPlant(seen, lambda o: dataclasses.replace(o, status=PlantStatus.LOST))
    done = ClosedLoop(plant, controller, safety=SAFETY).run(PoseTarget.turned(seen.state, axis, degrees=20))
    assert done.reason is Reason.OBJECT_LOST
    assert done.lost
    assert [step.report is not None for step in done.steps] == [True, False]


def test_the_learner_is_seen_motions_what_the_encoders_did(held) -> None:
    """Servos that go half of the way: the object's motion is learned for what they did."""
    seen, axis, loop = held
    ekm = EnhancedModel.for_grasp(loop.kinematic, seen.state)
    seen_motions = []
    update = ekm.update
    ekm.update = lambda s, da, ds, f: seen_motions.append((da, f)) or update(s, da, ds, f)  # type: ignore[method-assign]

    class Half(FrozenPlant):
        def move(self, delta_a: torch.Tensor) -> None:
            super().move(delta_a)
            old = self.observation
            self.observation = dataclasses.replace(old, a=old.a + 0.5 * delta_a, q=old.q + 1e-9)

    controller = LookAndMoveController(ekm, axis)
    knowledge = HandKnowledge.of(loop.kinematic.hand, adapts=False)
    driven = ClosedLoop(Half(seen), controller, knowledge=knowledge, safety=SAFETY, planner=OneStep())
    steps = driven.run(PoseTarget.turned(seen.state, axis, degrees=20)).steps
    for (da, nominal), step in zip(seen_motions, [s for s in steps if s.report is not None], strict=True):
        torch.testing.assert_close(da, step.after.a - step.before.a)
        torch.testing.assert_close(nominal, step.decision.linearization.step(da))
        assert not torch.allclose(da, step.decision.delta_a)
    assert bool((driven.knowledge.servo.dead_zone > 0).any())


# -- the hand holds whatever ends the loop ------------------------------------------------------------


class Noted(FrozenPlant):
    """Notes its commands; the second one fails with ``error``, if there is one."""

    def __init__(self, observation: Observation, error: BaseException | None = None) -> None:
        super().__init__(observation)
        self.given, self.error = [], error

    def command(self, delta_a: torch.Tensor) -> Observation:
        self.given.append(delta_a)
        if self.error is not None and len(self.given) == 2:
            raise self.error
        return super().command(delta_a)


def test_a_plant_that_fails_before_the_first_reading_raises(held) -> None:
    seen, axis, controller = held

    class Dead(FrozenPlant):
        def observe(self) -> Observation:
            raise OSError("no such port")

    with pytest.raises(OSError, match="no such port"):
        ClosedLoop(Dead(seen), controller).run(PoseTarget.turned(seen.state, axis, degrees=20))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("bus is down")])
def test_the_hand_holds_after_an_error_of_the_driver_and_after_ctrl_c(held, error) -> None:
    seen, axis, controller = held
    plant = Noted(seen, error)
    with ClosedLoop(plant, controller, safety=SAFETY) as loop:
        done = loop.run(PoseTarget.turned(seen.state, axis, degrees=20))
        assert not plant.closed
    assert plant.closed
    assert done.stop.cause is error
    assert done.reason is (Reason.PLANT_FAILED if isinstance(error, OSError) else Reason.STOPPED)
    assert done.stop.message in ("OSError: bus is down", "Ctrl-C")
    assert len(done.steps) == 1  # what was learned until then is there
    assert len(done.errors) == 2
    assert [bool(da.any()) for da in plant.given] == [True, True, False]


def test_the_hand_holds_after_an_error_of_the_caller_and_after_a_break(held) -> None:
    seen, axis, controller = held
    target = PoseTarget.turned(seen.state, axis, degrees=20)

    def fail(step) -> None:
        raise ZeroDivisionError

    plant = Noted(seen)
    with pytest.raises(ZeroDivisionError):
        watched(ClosedLoop(plant, controller, safety=SAFETY), target, fail)
    assert [bool(da.any()) for da in plant.given] == [True, False]
    plant = Noted(seen)
    motions = []  # alive when the block fails: it is the block that holds the hand

    def block() -> None:
        with ClosedLoop(plant, controller, safety=SAFETY) as loop:
            motions.append(loop.steps(target))
            fail(next(motions[0]))

    with pytest.raises(ZeroDivisionError):
        block()
    assert [bool(da.any()) for da in plant.given] == [True, False]
    plant = Noted(seen)
    motions = ClosedLoop(plant, controller, safety=SAFETY).steps(target)
    next(motions)
    motions.close()
    assert not bool(plant.given[-1].any())
    plant = Noted(seen)
    ClosedLoop(plant, controller, safety=SAFETY).run(target)  # an end of its own: the motors stand
    assert all(bool(da.any()) for da in plant.given)


def test_another_thread_stops_it_after_the_motion_under_way(held) -> None:
    seen, axis, controller = held
    plant = Noted(seen)
    loop = ClosedLoop(plant, controller, safety=SAFETY)

    def stop(step: object) -> None:
        worker = threading.Thread(target=loop.stop)
        worker.start()
        worker.join()  # on a busy machine it may come late

    done = watched(loop, PoseTarget.turned(seen.state, axis, degrees=20), stop)
    assert done.reason is Reason.STOPPED
    assert len(done.steps) <= 2
    assert loop.run(PoseTarget.turned(seen.state, axis, degrees=20)).reason is Reason.STALLED  # and again
