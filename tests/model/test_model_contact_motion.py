"""Motions whose contacts stick, slide, open and close: derivatives in each mode, and the simulated hand."""

import dataclasses

import pytest
import torch
from model_toys import F64, planar_two_finger, soft_two_finger
from turning_step import turning_step

from torch_ekm.estimation.hand_figures import HandFigures
from torch_ekm.exceptions import GraspError
from torch_ekm.model import (
    ContactMode,
    ContactMotion,
    KinematicModel,
    Linearization,
    contact_laws,
    contact_motion,
)
from torch_ekm.simulation import SimulatedHand

DEG = torch.pi / 180


def turning(lin, axis, step):
    return turning_step(lin, axis, step, lin.forces.normal, keep=0.3)


@pytest.fixture(scope="module")
def held():
    """Model, start, encoders and axis of a box in the hand as described."""
    plant = SimulatedHand("icub_right", "box", preset="none")
    seen = plant.reset(0).truth
    model = KinematicModel(plant.hand, plant.object)
    force = seen.fingertip_force
    start = model.linearize(seen.state, model.touching(seen.state), fingertip_force=force)
    yield model, start, plant.reset(0).a, plant.rotation_axis
    plant.close()


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections to the last digit, for differences."""
    monkeypatch.setattr(contact_motion, "_FINE", 1e-10)
    monkeypatch.setattr(contact_motion, "_SAME", 1e-10)
    monkeypatch.setattr(contact_motion, "_CORRECTIONS", 20)
    monkeypatch.setattr(contact_laws, "_TOLERANCE", 1e-13)


def differences(motion: ContactMotion, w: torch.Tensor, h: float) -> torch.Tensor:
    """``d increment/d da`` at w by central differences."""
    place = motion.state, None, motion.loads
    columns = []
    for e in torch.eye(len(w), dtype=F64):
        ends = []
        for sign in (1, -1):
            motion._stand(*place)
            ends.append(motion.move(w + sign * h * e).increment)
        columns.append((ends[0] - ends[1]) / (2 * h))
    motion._stand(*place)
    return torch.stack(columns, dim=1)


def off(motion: ContactMotion, w: torch.Tensor) -> float:
    """Relative error of the derivative in the mode of w; the little finger, which is free, is left out."""
    columns = [i for i, name in enumerate(motion.model.hand.actuator_names) if name != "pinky"]
    J, by_hand = (
        motion.linearize(w).manipulation_jacobian,
        differences(motion, w, 1e-4 * float(w.abs().max()))[:, columns],
    )
    return float((J[:, columns] - by_hand).norm() / by_hand.norm())


def compare(motion: ContactMotion, w: torch.Tensor) -> None:
    """The derivative is that of small motions, as exact as they are small."""
    errors = [off(motion, share * w) for share in (1e-2, 1e-3)]
    assert errors[1] < 1e-4
    assert errors[1] < 0.3 * errors[0]


def margin_slopes(lin: Linearization) -> torch.Tensor:
    """d margin/da [N/rad]."""
    still = torch.zeros(lin.manipulation_jacobian.shape[-1], dtype=torch.float64)
    return torch.autograd.functional.jacobian(lin.margins_after, still)


def test_where_contacts_stick_it_moves_as_the_manipulation_jacobian_says(held, exact) -> None:
    model, start, _, axis = held
    w = turning(start, axis, 0.5 * DEG)
    motion = ContactMotion(model, start)
    lin = motion.linearize(1e-3 * w)
    torch.testing.assert_close(lin.object_jacobian, start.object_jacobian, rtol=0, atol=1e-5)
    torch.testing.assert_close(
        lin.normal_force_sensitivity, start.normal_force_sensitivity, rtol=1e-4, atol=1e-2
    )
    torch.testing.assert_close(margin_slopes(lin), margin_slopes(start), rtol=1e-4, atol=1e-2)
    step = motion.move(w)
    assert set(step.modes.values()) <= {ContactMode.STICK, ContactMode.OPEN}
    assert (step.increment - start.step(w)).norm() < 0.05 * step.increment.norm()
    compare(motion, w)


def test_where_a_contact_slides_the_derivative_is_that_of_sliding(held, exact) -> None:
    model, start, a, axis = held
    motion, w = ContactMotion(model, start, a=a), turning(start, axis, 2.5 * DEG)
    for _ in range(4):
        step = motion.move(w)
    (slides,) = [name for name, mode in step.modes.items() if mode is ContactMode.SLIDE]
    assert step.normal[slides] > 0.5
    compare(motion, w)
    at = motion.linearize(1e-3 * w)
    k = at.contacts.finger.index(slides)
    assert abs(float(margin_slopes(at)[k] @ w)) < 1e-2 * float(at.normal_force_sensitivity[k].abs().max())


def test_pads_that_press_off_the_surface_go_on_bearing(held) -> None:
    """The object is 10 mm wider than described: its pads measure forces 5 mm off it."""
    model, true, _, _ = held
    thin = dataclasses.replace(model.obj, shapes=tuple(one.scaled(2 / 3) for one in model.obj.shapes))
    model, pads = KinematicModel(model.hand, thin), [pad.name for pad in model.hand.pads]
    force = torch.zeros(len(pads), dtype=F64)
    for name, normal in zip(true.contacts.finger, true.forces.normal, strict=True):
        force[pads.index(name)] = normal
    contacts = model.touching(true.state, force)
    assert contacts.gap.min() > contact_motion.NEAR
    motion = ContactMotion(model, model.linearize(true.state, contacts, fingertip_force=force))
    step = motion.move(torch.full((model.hand.n_a,), 0.05 * DEG, dtype=F64))
    assert {step.modes[name] for name in true.contacts.finger} == {ContactMode.STICK}
    for name in true.contacts.finger:
        assert abs(step.normal[name] - force[pads.index(name)]) < 0.3


def test_a_motion_far_from_everything_ends_the_grasp(held) -> None:
    model, start, _, _ = held
    away = dataclasses.replace(start.state, position=start.state.position + 0.1)
    with pytest.raises(GraspError, match="slips away"):
        ContactMotion(model, dataclasses.replace(start, state=away)).move(torch.zeros(9, dtype=F64))


def test_a_finger_that_is_taken_away_opens_and_bears_nothing(held) -> None:
    model, start, a, _ = held
    motion, away = ContactMotion(model, start, a=a), torch.zeros(model.hand.n_a, dtype=F64)
    away[model.hand.actuator_names.index("middle_proximal")] = -0.3
    step = motion.move(away)
    assert step.modes["middle"] is ContactMode.OPEN
    assert step.normal["middle"] == pytest.approx(0.0, abs=1e-9)
    assert step.normal["index"] > 0.3
    assert "middle" not in motion.linearize(1e-3 * away).contacts.finger


def test_a_link_comes_to_bear(exact) -> None:
    plant = SimulatedHand("icub_right", "tea_tin", preset="none")
    seen, axis = plant.reset(0), plant.rotation_axis
    model = KinematicModel(plant.hand, plant.object)
    start = now = model.linearize(seen.truth.state, fingertip_force=seen.truth.fingertip_force)
    motion = ContactMotion(model, start, a=seen.a)
    plant.close()
    for _ in range(14):
        w = turning(now, axis, 2.0 * DEG)
        step = motion.move(w)
        if step.normal.get("thumb_2", 0.0) > 0.3:
            break
        now = motion.linearize(1e-3 * w)
    assert step.modes["thumb_2"] is not ContactMode.OPEN
    gap = model.detector.near(step.state.q, step.state.position, step.state.rotation, 1e-3)
    assert abs(float(gap.gap[gap.finger.index("thumb_2")])) < 1e-6
    assert off(motion, 1e-3 * w) < 0.01  # an edge of the tin, along which the model lets nothing roll
    assert "thumb_2" in motion.linearize(1e-3 * w).contacts.finger


def test_a_motion_goes_on_as_from_contacts_that_are_found_anew(held) -> None:
    """After a small correction the next motion begins with its matrices: the reference places the grasp."""
    model, start, _, axis = held
    w, went_on = turning(start, axis, 1.0 * DEG), 0
    motion, reference = ContactMotion(model, start), ContactMotion(model, start)
    for _ in range(5):
        went_on += motion._placed is None and motion._near is not None
        reference._near = None
        ends = [one.move(w).state for one in (motion, reference)]
        assert float(ends[0].minus(ends[1]).abs().max()) < 1e-5
    assert went_on >= 2


def test_what_is_left_out_by_its_distance_is_beyond_the_margin(held) -> None:
    model, start, _, _ = held
    near, state = model.detector.near, start.state
    way = torch.ones(state.n_s, dtype=F64)
    way[-6:-3] = 0.05
    for k in range(-8, 9):
        posed = state.plus(0.03 * k * way)
        place = posed.q, posed.position, posed.rotation
        every, some = near(*place, torch.inf), near(*place, 0.01)
        kept = [i for i, gap in enumerate(every.gap.tolist()) if gap <= 0.01]
        assert some.finger == tuple(every.finger[i] for i in kept)
        torch.testing.assert_close(some.point, every.point[kept], rtol=0, atol=0)


def test_joints_follow_a_shift_and_contacts_stay_closed(held) -> None:
    """What a learner adds to the object's motion opens no contact."""
    model, start, _, _ = held
    motion = ContactMotion(model, start)
    increment = torch.zeros(start.state.n_s, dtype=F64)
    increment[-6:] = torch.tensor([3e-4, -2e-4, 1e-4, 0.5 * DEG, -1.0 * DEG, 0.7 * DEG])
    motion.shift(increment)
    torch.testing.assert_close(motion.state.minus(start.state)[-6:], increment[-6:], atol=1e-9, rtol=0.0)
    gap, still = start.contacts.gap, start.state.plus(increment)
    assert float((model.contacts(motion.state).gap - gap).abs().max()) < 1e-5
    assert float((model.contacts(still).gap - gap).abs().max()) > 1e-4  # where joints do not follow


def test_where_the_object_slips_away_nothing_has_moved(held) -> None:
    model, start, a, _ = held
    slippery = KinematicModel(model.hand, dataclasses.replace(model.obj, friction=0.05))
    lin = slippery.linearize(start.state, on_unstable="flag")
    motion = ContactMotion(slippery, lin, a=a)
    open_hand = torch.zeros(model.hand.n_a, dtype=F64)
    open_hand[1:3] = -0.2
    with pytest.raises(GraspError):
        motion.move(open_hand)
    assert motion.state is lin.state


def test_a_motion_that_lets_go_is_followed_and_does_not_leap(held) -> None:
    """Newton's method on the whole motion finds another equilibrium."""
    model, start, a, _ = held
    w = 0.1 * torch.randn(model.hand.n_a, generator=torch.Generator().manual_seed(30), dtype=F64)
    w[0] = w[-1] = 0.0
    whole, parts = (ContactMotion(model, start, a=a) for _ in range(2))
    whole.move(w)
    for _ in range(16):
        parts.move(w / 16)
    assert whole.state.minus(parts.state).norm() < 0.02 * whole.state.minus(start.state).norm()


def test_where_a_finger_slides_the_object_does_not_leap_to_another_equilibrium() -> None:
    """One program has two answers: the near one, and one with the object turned by 17 deg and more."""
    plant = SimulatedHand("icub_right", "flashlight", preset="none")
    seen = plant.reset(0).truth
    plant.close()
    model, force = (
        KinematicModel(plant.hand, dataclasses.replace(plant.object, friction=0.5)),
        seen.fingertip_force,
    )
    contacts = model.touching(seen.state, force)
    start = model.linearize(seen.state, contacts, fingertip_force=force, on_unstable="flag")
    for w in 0.03 * torch.randn(12, model.hand.n_a, generator=torch.Generator().manual_seed(0), dtype=F64):
        w[0] = w[-1] = 0.0
        step = ContactMotion(model, start).move(w)
        assert step.increment[-3:].norm() < 8 * DEG


def test_forces_answer_by_the_figures_that_are_known(held, exact) -> None:
    """Moment arms of the fingers a third larger, half the thumb's: against differences of motions."""
    model, start, _, _ = held
    figures = HandFigures.of(model.hand)
    arms = [name.startswith("moment arm") for name in figures.names]
    grow = torch.tensor([-0.5 if "thumb" in name else 0.3 for name in figures.names], dtype=torch.float64)
    figures.mean[arms] = (grow / torch.from_numpy(figures._prior_std))[arms]
    model = model.with_figures(figures)
    lin = model.linearize(start.state, start.contacts, forces=start.forces)
    found = ContactMotion(model, lin).answered(lin)
    assert found.described_normal_sensitivity is found.normal_force_sensitivity
    off = (found.normal_force_sensitivity - lin.normal_force_sensitivity).abs().max()
    assert float(off) > 0.1 * float(lin.normal_force_sensitivity.abs().max())
    h = 1e-5
    for i in range(model.hand.n_a):
        w = torch.zeros(model.hand.n_a, dtype=torch.float64)
        w[i] = h
        ends = [ContactMotion(model, lin).move(sign * w).normal for sign in (1, -1)]
        slope = [(ends[0][name] - ends[1][name]) / (2 * h) for name in lin.contacts.finger]
        assert found.normal_force_sensitivity[:, i].tolist() == pytest.approx(slope, abs=0.02, rel=0.02)


@pytest.mark.parametrize("toy", [planar_two_finger(), soft_two_finger(com=(0.0, 0.002, 0.0))])
def test_toys_move_as_their_jacobian_says(toy) -> None:
    """In a plane, with a detector of one's own; and with fingers that resist spin."""
    model, lin = toy.model, toy.model.linearize(toy.state, forces=toy.forces())
    found = ContactMotion(model, lin).linearize(torch.full((model.hand.n_a,), 1e-4, dtype=F64))
    for name, near in (("manipulation_jacobian", 1e-4), ("contact_force_sensitivity", 1e-3)):
        mine, its = getattr(found, name), getattr(lin, name)
        assert (mine - its).norm() < near * its.norm()


def test_steps_that_slide_are_predicted_better_than_by_contacts_that_stick() -> None:
    """Against the simulator; its friction is a pyramid, so a slide is not exact."""
    plant = SimulatedHand("icub_right", "box", preset="none")
    seen, axis = plant.reset(1), plant.rotation_axis
    model = KinematicModel(plant.hand, plant.object)
    sticks, steps = [], []
    for _ in range(8):
        state, force = seen.truth.state, seen.truth.fingertip_force
        lin = model.linearize(state, model.touching(state), fingertip_force=force)
        after = plant.command(turning(lin, axis, -3.0 * DEG))
        w, ds = after.a - seen.a, after.truth.state.minus(state)
        step = model.step(state, w, fingertip_force=force, a=seen.a)
        if ContactMode.SLIDE in step.modes.values():
            sticks.append(float((ds - model.linearize(state, fingertip_force=force).step(w))[-3:].norm()))
            steps.append(float((ds - step.increment)[-3:].norm()))
        seen = after
    plant.close()
    assert len(steps) >= 3
    assert sum(steps) < 0.5 * sum(sticks)
