"""What a movement of several pieces is expected to do, and what it teaches."""

import copy
import dataclasses
import math

import pytest
import torch
from obedient_plant import Obedient, untaught

from torch_ekm.control import (
    ClosedLoop,
    DescribedFigures,
    HandFigures,
    HandKnowledge,
    LookAndMoveController,
    PoseTarget,
)
from torch_ekm.control.lessons import Lessons
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel

DEG = math.pi / 180


@pytest.fixture(scope="module")
def taught(held) -> LookAndMoveController:
    """Its g is no zero."""
    seen, axis, model = held
    ekm, draw = EnhancedModel.for_grasp(model, seen.state), torch.Generator().manual_seed(0)
    for _ in range(10):
        w = 3 * DEG * torch.randn(model.hand.n_a, generator=draw, dtype=torch.float64)
        ekm.update(seen.state, w, 0.8 * model(seen.state, w))
    return LookAndMoveController(ekm, axis)


@pytest.fixture(scope="module")
def pieces(held, taught):
    seen, axis, model = held
    loop = ClosedLoop(Obedient(model, seen), taught)
    return tuple(
        one.piece for one in loop.plan(PoseTarget.turned(seen.state, axis, degrees=10)).waypoints[:4]
    )


def test_of_one_piece_it_is_f_and_g_of_what_the_tendons_did(held, taught) -> None:
    seen, axis, _ = held
    target = PoseTarget.turned(seen.state, axis, degrees=10)
    decision = taught.decide(seen.state, seen.a, target, seen.fingertip_force)
    (piece,) = decision.pieces
    J = piece.linearization.manipulation_jacobian
    for moved in (piece.action, 0.7 * piece.action, piece.action + 0.5 * DEG):
        expected = taught.expect(decision.pieces, moved)
        g, variance = taught.enhanced.correction(seen.state, moved, len(J))
        torch.testing.assert_close(expected.nominal, J @ moved, rtol=0, atol=1e-14)
        torch.testing.assert_close(expected.increment, J @ moved + g, rtol=0, atol=1e-14)
        assert torch.equal(expected.deviation, variance.sqrt())
        assert float(g.abs().max()) > 5e-5
    assert torch.equal(taught.expect(decision.pieces, piece.action).nominal, piece.nominal)


def test_of_a_path_its_pieces_compose(taught, pieces) -> None:
    extra = torch.linspace(-1, 1, len(pieces[0].action), dtype=torch.float64) * DEG
    moved = sum(one.action for one in pieces) + extra
    expected = taught.expect(pieces, moved)
    torch.testing.assert_close(sum(one.action for one in expected.pieces), moved)
    ways = torch.stack([one.action.norm() for one in pieces])
    f = both = pieces[0].state
    deviation = torch.zeros_like(pieces[0].nominal)
    for one, part in zip(pieces, ways / ways.sum(), strict=True):
        w = one.action + part * extra
        nominal = one.nominal + one.linearization.manipulation_jacobian @ (part * extra)
        g, variance = taught.enhanced.correction(one.state, w, len(nominal))
        f, both, deviation = f.plus(nominal), both.plus(nominal + g), deviation + variance.sqrt()
    torch.testing.assert_close(expected.nominal, f.minus(pieces[0].state), rtol=0, atol=1e-12)
    torch.testing.assert_close(expected.increment, both.minus(pieces[0].state), rtol=0, atol=1e-12)
    torch.testing.assert_close(expected.deviation, deviation)


@pytest.mark.parametrize(("made", "n"), [(1.0, 4), (0.95, 4), (0.4, 2), (0.1, 1), (0.0, 1), (-0.3, 1)])
def test_of_a_path_that_was_stopped_only_the_pieces_that_were_made_count(taught, pieces, made, n) -> None:
    alike = tuple(copy.copy(one) for one in pieces)
    for one in alike:
        object.__setattr__(one, "action", pieces[0].action)
    moved = made * 4 * pieces[0].action
    expected = taught.expect(alike, moved)
    assert len(expected.pieces) == n
    torch.testing.assert_close(sum(one.action for one in expected.pieces), moved)
    assert torch.equal(expected.moved, moved)


def test_g_learns_each_piece_with_its_share(taught, pieces, monkeypatch) -> None:
    controller = copy.copy(taught)
    controller.enhanced = copy.deepcopy(taught.enhanced)
    expected = controller.expect(pieces, sum(one.action for one in pieces))
    rest = torch.zeros_like(expected.increment)
    rest[-6:] = torch.tensor([1e-3, -1e-3, 2e-3, 1 * DEG, -0.5 * DEG, 0.5 * DEG])
    came, told = expected.increment + rest, []
    update = controller.enhanced.update
    monkeypatch.setattr(controller.enhanced, "update", lambda *lesson: told.append(lesson) or update(*lesson))
    known = HandKnowledge.of(controller.kinematic.hand)
    lessons = Lessons(controller, known, DescribedFigures())
    lessons.learn_increment(expected, expected.moved, came)
    there = start = pieces[0].state
    ways = torch.stack([one.action.norm() for one in pieces])
    taught_so = zip(told, expected.pieces, ways / ways.sum(), strict=True)
    for (state, w, increment, nominal), one, share in taught_so:
        torch.testing.assert_close(increment, one.increment + share * rest)
        torch.testing.assert_close(nominal, one.nominal)
        assert w is one.action
        assert float(state.minus(there)[-3:].norm()) < 0.1 * DEG  # one follows from the other
        there = there.plus(increment)
    assert float((there.minus(start) - came)[-3:].norm()) < 0.05 * DEG
    for _ in range(30):
        lessons.learn_increment(controller.expect(pieces, expected.moved), expected.moved, came)
    left = (came - controller.expect(pieces, expected.moved).increment)[-3:].norm()
    assert float(left) < 0.1 * float(rest[-3:].norm())


def test_a_motion_is_a_path_of_one_piece(held, pieces) -> None:
    one, other = (HandFigures.of(held[2].hand) for _ in range(2))
    for piece in pieces:
        lin, w = piece.linearization, piece.action
        nominal = one.solve(lin.equations).jacobian @ w
        came = 0.8 * nominal
        one.learn(lin, w, came)
        other.learn_path([(lin, w)], w, came - nominal, nominal)
    assert int(one.count) == len(pieces)
    for name, value in one.state_dict().items():
        torch.testing.assert_close(value, other.state_dict()[name], rtol=0, atol=1e-14)
    assert float(one.mean.abs().max()) > 0.1


@pytest.mark.parametrize(("less", "learns"), [(0.3, True), (4.0, False)])
def test_a_finger_that_slid_or_gave_its_load_away_says_nothing_of_forces(held, less, learns) -> None:
    (seen, axis, _), loop = held, untaught(held)
    controller, target = loop.controller, PoseTarget.turned(seen.state, axis, degrees=5)
    decision = controller.decide(seen.state, seen.a, target, seen.fingertip_force)
    expected = controller.expect(decision.pieces, decision.delta_a)
    state, force = seen.state.plus(expected.increment), expected.normal.nan_to_num()
    force[0] -= less
    after = dataclasses.replace(
        seen, q=state.q, position=state.position, rotation=state.rotation, fingertip_force=force
    )
    lessons = Lessons(controller, loop.knowledge, loop.knowledge.figures)
    lessons.learn(seen, decision, after, decision.delta_a, expected, True)
    assert bool(loop.knowledge.forces.evidence.any()) is learns


def test_pads_that_press_off_the_surface_say_where_it_is(held) -> None:
    """The box is 4.5 mm wider than it is described; each reading counts, and a manipulation begins anew."""
    seen, axis, model = held
    shapes = tuple(shape.scaled(0.85) for shape in model.obj.shapes)
    thin = KinematicModel(model.hand, dataclasses.replace(model.obj, shapes=shapes))
    for told, learns, surface in ((thin, True, 0.00225), (thin, False, 0.0), (model, True, 0.0)):
        controller = LookAndMoveController(EnhancedModel.for_grasp(told, seen.state), axis)
        known = HandKnowledge.of(model.hand)
        controller.follow(known.figures, known.forces)
        lessons = Lessons(controller, known, known.figures if learns else DescribedFigures())
        lessons.touch(seen, lambda _: 0.0)  # joints that are off explain it better
        assert controller.kinematic.surface == 0.0
        lessons.touch(seen, lambda _: math.inf)
        followed = controller.kinematic
        assert followed.surface == pytest.approx(surface, abs=0.0005)
        if surface:
            gaps = followed.contacts(seen.state, seen.fingertip_force).gap
            described = thin.contacts(seen.state, seen.fingertip_force).gap
            assert float(gaps.abs().max()) < 0.0005 < float(described.min())
        assert told.surface == 0.0
        lessons.begin(seen)
        assert followed.surface == 0.0
