"""A turn as one movement: its path on the model, and how far along it is safe."""

import copy
import dataclasses
import math
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from obedient_plant import Obedient, untaught

from torch_ekm.control import (
    ClosedLoop,
    EffortTask,
    FocusTask,
    GripForceTask,
    HandKnowledge,
    LookAndMoveController,
    ModelHand,
    NormalForceLimit,
    OffAxisTask,
    PathEnd,
    PoseTarget,
    Situation,
    StopReason,
    WholeTurn,
)
from torch_ekm.control.program import LinearizedModel
from torch_ekm.control.rehearsal import Rehearsal
from torch_ekm.description import load_object
from torch_ekm.exceptions import StateError
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180


@pytest.fixture(scope="module")
def loop(held) -> ClosedLoop:
    """With an E-KM of which nothing is known."""
    return untaught(held)


@pytest.fixture(scope="module")
def target(held) -> PoseTarget:
    return PoseTarget.turned(held[0].state, held[1], degrees=15)


def test_a_path_is_that_of_the_model_hand(held, loop, target) -> None:
    seen = loop.plant.observe()
    controller = loop.controller
    plan = WholeTurn().plan(controller, seen, target, loop.knowledge, 0.0, whole=True)
    hand = ModelHand(controller.enhanced, seen.state, seen.a, seen.fingertip_force, controller.forces)
    for one, before in zip(plan.waypoints, plan.states, strict=False):
        there = hand.command(one.piece.action)
        assert torch.equal(there.rotation, one.state.rotation)
        assert torch.equal(one.piece.state.q, before.q)
        torch.testing.assert_close(one.state.minus(before), one.piece.increment, rtol=0, atol=1e-9)
    assert all(after < before for before, after in pairwise(plan.errors))
    assert plan.errors[0] == pytest.approx(15 * DEG, abs=0.3 * DEG)
    assert plan.end.kind is PathEnd.NOTHING
    assert plan.errors[-1] < 0.3 * DEG
    lines = str(plan).splitlines()
    assert len(lines) == 1 + len(plan.waypoints)
    assert f"{plan.safe} of {len(plan.waypoints)} waypoints are safe" in lines[0]
    assert "deg to go" in lines[-1]
    assert "off the axis" in lines[-1]


@pytest.fixture(scope="module")
def slippery(held) -> KinematicModel:
    """The same grasp of a box with a third of its friction."""
    return KinematicModel(held[2].hand, dataclasses.replace(load_object("box"), friction=0.3))


def test_the_tangent_is_that_of_the_motion_in_which_a_pad_slides(held, slippery) -> None:
    """Against differences of motions; the linearization where it begins is off by more than a degree."""
    seen, hand = held[0], ModelHand(slippery, held[0].state, held[0].a, held[0].fingertip_force)
    w = torch.zeros_like(seen.a)
    w[hand.hand.actuator_names.index("middle_distal")] = 0.08
    first = hand.linearization
    J, rest = hand.tangent(w)
    assert torch.equal(hand.a, seen.a)  # nothing moves

    def moved(way: torch.Tensor) -> torch.Tensor:
        there = copy.copy(hand)
        there.command(way)
        return there.increment

    torch.testing.assert_close(J @ w + rest, moved(w), rtol=0, atol=1e-9)
    assert float((first.step(w) - moved(w))[-3:].norm()) > 1 * DEG
    for i in range(len(w) - 1):  # the last one stands at the end of its range
        h = torch.zeros_like(w)
        h[i] = 1e-4
        found = (moved(w + h) - moved(w - h)) / 2
        assert float((J @ h - found).norm()) < 0.05 * float(found.norm())


def rehearsal(controller: LookAndMoveController, seen, target: PoseTarget | None) -> Rehearsal:
    return Rehearsal(controller, HandKnowledge.of(controller.kinematic.hand), seen, target, 2.5 * DEG)


def test_a_piece_in_which_a_pad_slides_is_chosen_about_where_it_leads(held, slippery) -> None:
    seen, axis, _ = held
    tasks = [EffortTask(), OffAxisTask(translation_weight=0.05), GripForceTask(), FocusTask()]  # let it slide
    controller = LookAndMoveController(slippery, axis, tasks)
    target = PoseTarget.turned(seen.state, axis, degrees=-15)
    path = [one.state for one in rehearsal(controller, seen, target).path()]
    assert len(path) <= 8
    assert controller.focus.error(target, path[-1]) < 0.1 * DEG
    assert controller.focus.off_rotation(path[-1].minus(seen.state)) < 0.2 * DEG


def test_a_grasp_that_its_forces_make_soft_is_gripped_no_harder(held, monkeypatch):
    seen, axis, model = held
    controller = LookAndMoveController(
        model, axis, tasks=[EffortTask(), GripForceTask(force=8.0), FocusTask()]
    )
    lin = model.linearize(seen.state, fingertip_force=seen.fingertip_force)

    def gripped() -> tuple[float, float]:
        made = rehearsal(controller, seen, None)
        forces = [one.piece.force for one in made.path()]
        return made.first.grip.wanted, max((float(force.max()) for force in forces), default=0.0)

    wanted, most = gripped()
    assert wanted == 8.0
    assert most > 7.0
    linearize = KinematicModel.linearize

    def softer(self, *args, **options):
        """Without forces it would be twice as stiff."""
        found = linearize(self, *args, **options)
        free = options.get("forces") is not None and not bool(options["forces"].mu.any())
        return dataclasses.replace(found, stability=2 * found.stability) if free else found

    monkeypatch.setattr(KinematicModel, "linearize", softer)
    wanted, most = gripped()
    assert wanted == pytest.approx(float(lin.forces.normal.max()), abs=0.3)
    assert most < wanted + 0.3


def test_an_object_stays_in_its_place_along_the_grip_while_it_turns(held) -> None:
    """With a quarter of the weight of its place it goes by 3.2 mm."""
    seen, axis, model = held
    controller, target = LookAndMoveController(model, axis), PoseTarget.turned(seen.state, axis, degrees=-10)
    *_, last = rehearsal(controller, seen, target).path()
    end = last.state
    assert float((end.position - seen.position).norm()) < 2.7e-3
    assert controller.focus.off_rotation(end.minus(seen.state)) < 0.6 * DEG


def test_a_plan_changes_nothing(loop, target) -> None:
    known, controller = copy.deepcopy(loop.learned.state_dict()), loop.controller
    before = copy.copy(vars(controller)), copy.copy(vars(loop.knowledge.figures))
    given = list(loop.plant.plant.plant.given)
    assert loop.plan(target).waypoints
    assert loop.reach(limit=5 * DEG).plan.waypoints
    now = loop.learned.state_dict().items()
    assert all(torch.equal(x, known[name]) for name, x in now if isinstance(x, torch.Tensor))
    for was, now in zip(before, (vars(controller), vars(loop.knowledge.figures)), strict=True):
        assert all(now[name] is value for name, value in was.items() if name != "_solved")
    assert loop.plant.plant.plant.given == given


def test_a_hand_of_which_nothing_is_known_goes_piece_by_piece(loop, target) -> None:
    plan = loop.plan(target)
    assert 1 <= plan.safe <= 3 < len(plan.waypoints)
    assert plan.against
    short = WholeTurn().plan(loop.controller, loop.plant.observe(), target, loop.knowledge, 0.0)
    pieces = short.decision.pieces
    assert len(pieces) == short.safe
    torch.testing.assert_close(short.decision.delta_a, torch.stack([one.action for one in pieces]).sum(0))
    torch.testing.assert_close(
        short.decision.predicted, short.states[short.safe].minus(short.start), rtol=0, atol=1e-12
    )


def test_the_safer_the_model_the_farther_it_goes_at_once(held, target) -> None:
    seen, axis, model = held
    controller, knowledge = LookAndMoveController(model, axis), HandKnowledge.of(model.hand)
    knowledge.forces.evidence[:] = 1e6 * torch.eye(knowledge.forces.evidence.shape[-1])
    safe = []
    for share in (0.0, 0.1, 0.3, 0.6, 1.0):
        knowledge.error.square[:] = share**2
        plan = WholeTurn().plan(controller, seen, target, knowledge, 0.0, whole=True)
        safe.append(plan.safe)
        assert bool(plan.against) is (plan.safe < len(plan.waypoints))
    assert safe[0] == len(plan.waypoints)
    assert safe == sorted(safe, reverse=True)
    assert safe[-1] < 4


def test_a_waypoint_at_which_a_finger_may_slide_is_not_safe(held, loop, target) -> None:
    plan = loop.plan(target)
    first, last = plan.waypoints[0], plan.waypoints[1]
    last = dataclasses.replace(last, band=dataclasses.replace(last.band, force=last.band.force + 3.0))
    need = 2 * last.piece.linearization.contacts.friction.mean() * last.band.force_std
    spare = torch.full_like(need, 10.0)
    for share, safe in ((1.1, True), (0.9, False)):
        hand = SimpleNamespace(margin=share * need)
        against = WholeTurn()._against([first, last], math.inf, hand, spare)
        assert ("slide" not in against) is safe
        # it had none to spare
        assert "slide" not in WholeTurn()._against([first, last], math.inf, hand, 0.8 * need)


def test_margins_of_a_hand_whose_forces_are_not_learned_change_as_it_moves(held, target) -> None:
    seen, axis, model = held
    controller = LookAndMoveController(model, axis)
    hand = ModelHand(model, seen.state, seen.a, seen.fingertip_force)
    spare = hand.margin
    hand.command(controller.decide(seen.state, seen.a, target, seen.fingertip_force).delta_a)
    grasp = model.linearize(hand.state, fingertip_force=hand.force, on_unstable="flag")
    rows, pads = model.hand.pad_rows(grasp.contacts.finger)
    assert (hand.margin - spare).abs().max() > 0.05
    torch.testing.assert_close(hand.margin[pads], grasp.forces.margin[rows], rtol=0, atol=1e-9)


def test_a_movement_is_no_longer_than_it_is_asked_to_be(loop, target) -> None:
    seen = loop.plant.observe()
    plan = WholeTurn().plan(loop.controller, seen, target, loop.knowledge, 0.0, whole=True, longest=8 * DEG)
    assert plan.end.kind is PathEnd.WAY
    way = torch.stack([one.piece.action for one in plan.waypoints]).sum(0)
    assert 3 * DEG < float(way.abs().max()) <= 8 * DEG


def test_a_turn_that_is_given_up_names_what_is_not_safe(held, loop) -> None:
    """The object shall be 11 deg off the axis that is held, and the model is sure of nothing."""
    seen, axis, model = held
    across = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    there = PoseTarget.turned(PoseTarget.turned(seen.state, across, degrees=11), axis, degrees=10)
    doubtful = ClosedLoop(Obedient(model, seen), loop.controller, knowledge=loop.knowledge)
    doubtful.knowledge.error.begin = lambda: doubtful.knowledge.error.square.fill_(1.0)
    done = doubtful.run(there)
    del doubtful.knowledge.error.begin
    assert done.reason is StopReason.GIVEN_UP
    assert "the object may turn" in done.stop.message
    assert not any(step.decision.turns for step in done.steps)


def test_two_loops_with_different_knowledge_share_no_controller(held, target) -> None:
    seen, _, model = held
    first = untaught(held)
    controller = first.controller
    second = ClosedLoop(Obedient(model, seen), controller)
    assert first.knowledge.figures is second.knowledge.figures  # the second one goes on with them
    other = ClosedLoop(Obedient(model, seen), controller, knowledge=HandKnowledge.of(model.hand))
    for loop in (first, second):
        with pytest.raises(StateError, match="other knowledge"):
            next(loop.steps(target))
        assert not loop.plant.plant.plant.given
    assert next(other.steps(target)).after is not None


def test_contacts_of_links_are_no_pads() -> None:
    plant = SimulatedHand("icub_right", "tea_tin", preset="none")
    seen = plant.reset(0)
    model = KinematicModel(plant.hand, plant.object)
    controller = LookAndMoveController(model, plant.rotation_axis)
    far = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=60)
    plan = WholeTurn().plan(controller, seen, far, HandKnowledge.of(plant.hand), 0.0, whole=True)
    lins = [one.piece.linearization for one in plan.waypoints]
    lin = next(one for one in lins if set(one.contacts.finger) - {pad.name for pad in plant.hand.pads})
    fingers = lin.contacts.finger
    pads = [i for i, name in enumerate(fingers) if name in {pad.name for pad in plant.hand.pads}]
    (link,) = set(range(len(fingers))) - set(pads)
    error = far.error(lin.state)
    at = controller.situation(lin, seen.a, seen.fingertip_force, error, error[:1])
    assert at.pads(lin) == pads
    assert at.normal_force(lin)[link] == float(lin.forces.normal[link])  # no pad measures it
    about = LinearizedModel.about(0 * seen.a, lin)
    assert len(GripForceTask().rows(about, at).A) == len(pads)
    assert len(NormalForceLimit().rows(about, at).C) == 2 * len(pads)
    grip = controller.grip(lin, at)
    assert len(grip.force) == len(grip.least) == len(pads)
    assert isinstance(at, Situation)
