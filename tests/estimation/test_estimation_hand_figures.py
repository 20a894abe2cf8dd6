"""The figures of a hand, learned from how objects move."""

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch

from torch_ekm.control import DescribedFigures, HandFigures
from torch_ekm.description import load_hand
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ShapeError, StateError
from torch_ekm.model import ContactMotion, KinematicModel
from torch_ekm.simulation import SimulatedHand

F64 = torch.float64


@pytest.fixture(scope="module")
def held():
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=4)
    return seen.state, KinematicModel(plant.hand, plant.object)


@pytest.fixture(scope="module")
def other(held):
    """The same hand with pulleys 1.3 times as large, one of 1.5 times, and soft tendons."""
    _, model = held
    hand = model.hand
    arms = 1.3 * hand.actuation_jacobian
    arms[hand.actuator_names.index("index_proximal")] *= 1.5 / 1.3
    actuators = tuple(dataclasses.replace(one, stiffness=0.6 * one.stiffness) for one in hand.actuators)
    made = dataclasses.replace(
        hand, actuation_jacobian=arms, actuators=actuators, spring_stiffness=0.8 * hand.spring_stiffness
    )
    return KinematicModel(made, model.obj, kinematics=model.kinematics, detector=model.detector)


def motions(state, model, true, n: int, seed: int = 0, noise: float = 0.0):
    """(linearization, w, ds) near a state; forces are those of the description, as the filter takes them."""
    draw = torch.Generator().manual_seed(seed)
    where = state
    for _ in range(n):
        lin = model.linearize(where)
        w = math.radians(3) * torch.randn(model.hand.n_a, generator=draw, dtype=F64)
        w[0], w[-1] = 0.0, 0.0
        ds = true.linearize(where, lin.contacts, forces=lin.forces).step(w)
        yield lin, w, ds + noise * torch.randn(len(ds), generator=draw, dtype=F64)
        where = state.plus(0.2 * torch.randn(1, generator=draw, dtype=F64) * ds)


def error(figures, stream) -> tuple[float, float]:
    """Mean errors of the object's twist: with the figures, and of the description."""
    errors = []
    for lin, w, ds in stream:
        motion = figures.solve(lin.equations)
        errors.append([float((J @ w - ds)[-6:].norm()) for J in (motion.jacobian, lin.manipulation_jacobian)])
    return tuple(np.mean(errors, axis=0))


@pytest.fixture(scope="module")
def learned(held, other) -> HandFigures:
    state, model = held
    figures = HandFigures.of(model.hand)
    for lin, w, ds in motions(state, model, other, 30, noise=1e-4):
        figures.learn(lin, w, ds)
    return figures


def test_nothing_learned_is_the_description(held) -> None:
    state, model = held
    figures = HandFigures.of(model.hand)
    followed = model.with_figures(figures)
    lin, same = followed.linearize(state), model.linearize(state)
    torch.testing.assert_close(lin.manipulation_jacobian, same.manipulation_jacobian, rtol=0, atol=1e-13)
    assert model.figures is None
    assert "not identified" in str(figures)
    assert not any(figure.identified for figure in figures.figures)


def test_motions_that_were_not_seen_are_predicted(held, other, learned) -> None:
    state, model = held
    mine, described = error(learned, motions(state, model, other, 10, seed=9))
    assert mine < 0.1 * described


def test_what_motions_tell_is_found_and_the_rest_is_said_to_be_unknown(learned) -> None:
    found = {one.name: one for one in learned.figures}
    arm = found["moment arm of index_proximal at index_1"]
    assert arm.identified
    assert arm.factor == pytest.approx(1.5, abs=0.15)
    assert not found["spring of little_1"].identified  # the finger does not touch
    assert f"moment arm of index_proximal at index_1: {arm.factor:.2f} times" in str(learned)
    assert "spring of little_1" in str(learned).split("not identified")[1]


def test_a_tendon_that_is_replaced_is_learned_anew(held, other, learned) -> None:
    state, model = held
    hand = other.hand
    arms = hand.actuation_jacobian.copy()
    arms[hand.actuator_names.index("thumb_distal")] *= 0.3
    new = KinematicModel(
        dataclasses.replace(hand, actuation_jacobian=arms), model.obj, kinematics=model.kinematics,
        detector=model.detector,
    )  # fmt: skip
    figures = copy.deepcopy(learned)
    for lin, w, ds in motions(state, model, new, 12, seed=3, noise=1e-4):
        figures.learn(lin, w, ds)
    was, now = (
        {one.name: one.factor for one in known.figures if "arm of thumb_distal" in one.name}
        for known in (learned, figures)
    )
    assert max(was, key=lambda name: abs(math.log(now[name] / was[name])))
    mine, described = error(figures, motions(state, model, new, 10, seed=9))
    assert mine < 0.3 * described


def test_the_enhanced_model_adapts_outside_a_loop_too(held, other) -> None:
    state, model = held
    ekm = EnhancedModel.for_grasp(model, state)
    fixed = EnhancedModel.for_grasp(model, state, figures=DescribedFigures())
    for lin, w, ds in motions(state, model, other, 10):
        ekm.update(lin.state, w, ds)
        fixed.update(lin.state, w, ds)
    assert int(ekm.model.figures.count) == 10
    lin, w, ds = next(iter(motions(state, model, other, 1, seed=9)))
    torch.testing.assert_close(ekm.nominal(state, w), ekm.model.figures.solve(lin.equations).jacobian @ w)
    torch.testing.assert_close(fixed.nominal(state, w), lin.step(w))
    wrong = [float((one(state, w) - ds)[-6:].norm()) for one in (ekm, fixed)]
    assert wrong[0] < 0.5 * wrong[1]


def test_a_motion_that_is_left_out_teaches_neither_figures_nor_learner(held) -> None:
    """``on_invalid="skip"``: counted, and nothing else; "raise" names what is wrong."""
    state, model = held
    for on_invalid in ("skip", "raise"):
        ekm = EnhancedModel.for_grasp(model, state)
        ekm.learner.on_invalid = on_invalid
        w, ds = torch.zeros(model.hand.n_a, dtype=F64), torch.full((state.n_s,), math.nan, dtype=F64)
        if on_invalid == "skip":
            ekm.update(state, w, ds)
            assert int(ekm.learner.n_refused) == 1
        else:
            with pytest.raises(NonFiniteError, match="increment"):
                ekm.update(state, w, ds)
        assert int(ekm.model.figures.count) == 0


def test_bad_motions_are_refused_bit_for_bit(held, other, learned, unchecked) -> None:
    state, model = held
    lin, w, ds = next(iter(motions(state, model, other, 1)))
    kept = {name: value.clone() for name, value in learned.state_dict().items()}
    with pytest.raises(NonFiniteError, match="increment"):
        learned.learn(lin, w, ds * math.nan)
    with pytest.raises(ShapeError, match="moved"):
        learned.learn(lin, w[:-1], ds)
    assert learned.learn(lin, 0 * w, ds) is None
    assert all(torch.equal(value, kept[name]) for name, value in learned.state_dict().items())


def test_the_figures_of_another_hand_are_refused_by_name_and_digest(held, learned) -> None:
    _, model = held
    learned.check(model.hand)
    with pytest.raises(StateError, match=r"those of 'icub_right' \([0-9a-f]{8}\), not of 'yale_t42"):
        learned.check(load_hand("yale_t42"))
    corrected = dataclasses.replace(model.hand, spring_stiffness=2 * model.hand.spring_stiffness)
    with pytest.raises(StateError, match=r"spring of thumb_0 0.01 there, 0.02 in the description"):
        learned.check(corrected)


def test_motions_with_contacts_go_by_the_learned_figures(held, learned) -> None:
    state, model = held
    followed = model.with_figures(learned)
    lin = followed.linearize(state, followed.touching(state))
    w = torch.full((model.hand.n_a,), 1e-5, dtype=F64)
    found = ContactMotion(followed, lin).linearize(w).object_jacobian
    described, follows = model.linearize(state).object_jacobian, lin.object_jacobian
    size = float(follows.norm())
    assert float((found - follows).norm()) < 1e-3 * size
    assert float((described - follows).norm()) > 0.05 * size


PLAY = math.radians(0.8)


def test_motors_do_what_the_tendons_shall_do_and_the_play_on_top(held) -> None:
    _, model = held
    figures = HandFigures.of(model.hand)
    n = model.hand.n_a
    assert torch.equal(figures.pulled(torch.ones(n).double()), torch.ones(n).double())  # no grasp yet
    a, half = torch.zeros(n, dtype=F64), 0.5 * figures.width
    figures.begin(a)
    at = figures._at[-1][0]
    assert torch.rad2deg(figures.width).tolist() == pytest.approx([0.5] * len(at))
    for wanted, lost in ((0.03, half), (0.02, 0 * half), (-0.02, -2 * half), (-1e-5, 0 * half)):
        pull = torch.full((n,), wanted, dtype=F64)
        w = figures.motors(pull)
        torch.testing.assert_close((w - pull)[at], lost, rtol=0, atol=1e-12)
        if abs(wanted) > 1e-3:
            torch.testing.assert_close(figures.pulled(w), pull, rtol=0, atol=1e-12)
        a = a + w
        figures.commit(w, a)
    stands = figures._play
    figures.begin(a)  # where the last motion ended
    assert figures._play is stands
    figures.begin(a + 0.1)  # another grasp
    assert float(abs(figures._play.position).max()) == 0


def test_play_is_found_from_motions_that_reverse(held) -> None:
    state, model = held
    figures, true = HandFigures.of(model.hand), HandFigures.of(model.hand)
    true.mean[true._is_play] = math.degrees(PLAY)
    a = torch.zeros(model.hand.n_a, dtype=F64)
    draw, lin = torch.Generator().manual_seed(0), model.linearize(state)
    figures.begin(a)
    true.begin(a)
    errors = []
    for _ in range(40):
        w = math.radians(3) * torch.randn(len(a), generator=draw, dtype=F64)
        ds = lin.step(true.pulled(w))
        errors.append(float((lin.step(figures.pulled(w)) - ds).norm()))
        figures.learn(lin, w, ds)
        a = a + w
        figures.commit(w, a)
        true.commit(w, a)
    assert np.mean(errors[-10:]) < 0.35 * np.mean(errors[:5])
    found = torch.rad2deg(figures.width)
    assert found.median() == pytest.approx(math.degrees(PLAY), abs=0.1)
    assert "backlash of index_distal: " in str(figures)


def test_a_motion_against_its_prediction_teaches_no_figures(held) -> None:
    state, model = held
    figures = HandFigures.of(model.hand)
    lin = model.linearize(state)
    w = torch.full((model.hand.n_a,), 0.03, dtype=F64)
    assert figures.learn(lin, w, -lin.step(w)) is None
    assert int(figures.count) == 0
    assert figures.learn(lin, w, 0.7 * lin.step(w)) is not None
