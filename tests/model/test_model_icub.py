"""The iCub hand itself in a three-finger pinch: 20 joints, 9 compliant actuators, box and can."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from missing_terms import without
from model_icub import DEG, F64, gripped
from model_toys import finite_difference_jacobian, relative_error, step_error_slope

from torch_ekm.contact import ForceOptions
from torch_ekm.exceptions import ShapeError
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelStatus


def truth(shape, **options):
    _, solver, at = gripped(shape, **options)
    return finite_difference_jacobian(solver, at, 2e-4)


def variant(model, **changes):
    options = dataclasses.replace(model.options, **changes)
    return KinematicModel(
        model.hand, model.obj, options, kinematics=model.kinematics, detector=model.detector
    )


@pytest.mark.parametrize(("shape", "options"), [("box", {}), ("can", {}), ("box", {"gamma": 0.004})])
def test_jacobian_equals_finite_differences_of_exact_equilibria(shape, options):
    model, solver, at = gripped(shape, **options)
    J = model.linearize(at.state, at.contacts, forces=solver.forces(at)).manipulation_jacobian
    assert J.shape == (26, 9)
    assert relative_error(J, truth(shape, **options), 20) < 1e-9


@pytest.mark.parametrize("shape", ["box", "can"])
def test_forces_are_found_from_the_state(shape):
    model, _, at = gripped(shape)
    lin = model.linearize(at.state, at.contacts)
    assert lin.status is ModelStatus.OK
    assert (lin.forces.mu - at.mu).norm() < 1e-4 * at.mu.norm()
    assert lin.forces.residual.abs().max() < 1e-5
    assert relative_error(lin.manipulation_jacobian, truth(shape), 20) < 1e-4


@pytest.mark.parametrize("shape", ["box", "can"])
def test_order_of_convergence_and_what_breaks_it(shape):
    model, solver, at = gripped(shape)
    forces = solver.forces(at)
    directions = torch.randn(3, 9, dtype=F64, generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=-1, keepdim=True)
    sizes = [0.25e-3, 0.5e-3, 1e-3]  # [rad]
    J = model.linearize(at.state, at.contacts, forces=forces).manipulation_jacobian
    slopes = step_error_slope(solver, at, J, directions, sizes)
    assert ((slopes > 1.95) & (slopes < 2.05)).all(), slopes
    for terms in (("S", "T"), ("rolling",)):
        J = without(model, *terms).linearize(at.state, at.contacts, forces=forces).manipulation_jacobian
        assert (step_error_slope(solver, at, J, directions, sizes) < 1.2).all()
        assert relative_error(J, truth(shape), 20) > 5e-3  # against 1e-9 of the whole


def test_force_sensitivities_of_the_pinch():
    model, solver, at = gripped("box")
    lin = model.linearize(at.state, at.contacts, forces=solver.forces(at))

    def read(e):
        forces = solver.forces(e)
        return torch.cat([e.lam, forces.normal, forces.margin])

    expected = finite_difference_jacobian(solver, at, 5e-5, read)  # |f_t| bends sharply near 0
    ours = [lin.actuator_force_sensitivity, lin.normal_force_sensitivity, lin.margin_sensitivity]
    for part, difference in zip(ours, expected.split([9, 3, 3]), strict=True):
        assert (part - difference).norm() < 1e-6 * difference.norm()


def test_free_fingers_and_couplings():
    model, solver, at = gripped("box")
    J = model.linearize(at.state, at.contacts, forces=solver.forces(at)).joint_jacobian
    names = model.hand.joint_names
    C = torch.as_tensor(model.hand.coupling)
    assert (C @ J).abs().max() < 1e-12
    pinky = model.hand.actuator_names.index("pinky")
    ring = [names.index(f"ring_{k}") for k in (1, 2, 3)]
    assert (J[ring, pinky] - J[ring, pinky].mean()).abs().max() < 1e-9  # equal springs share equally
    fingers = [k for k, name in enumerate(names) if name.startswith(("thumb", "index", "middle"))]
    assert J[fingers, pinky].abs().max() < 1e-12


def noisy_states(at, draws, seed):
    generator = torch.Generator().manual_seed(seed)
    for _ in range(draws):
        noise = torch.randn(26, dtype=F64, generator=generator)
        noise[:20] *= 0.5 * DEG
        noise[20:23] *= 0.5e-3
        noise[23:] *= 0.5 * DEG
        yield at.state.plus(noise)


def test_with_noise_forces_are_found_and_the_jacobian_stays_near():
    model, solver, at = gripped("box")
    model = variant(model, on_unstable="flag")
    errors, solved, exact = [], 0, truth("box")
    for state in noisy_states(at, 30, 0):
        contacts = solver.surfaces(state.q, state.position, state.rotation)
        lin = model.linearize(state, contacts)
        solved += lin.forces.solved
        assert torch.isfinite(lin.manipulation_jacobian).all()
        assert float(lin.forces.margin.min()) > -1e-6
        errors.append(relative_error(lin.manipulation_jacobian, exact, 20))
    assert solved == 30
    assert np.median(errors) < 0.15


def test_a_joint_at_its_stop_is_held_and_a_pull_away_from_it_is_not():
    model, solver, at = gripped("box")
    forces = solver.forces(at)
    free = model.linearize(at.state, at.contacts, forces=forces)
    j = model.hand.joint_names.index("thumb_1")
    lower, upper = model.hand.joint_lower.copy(), model.hand.joint_upper.copy()
    assert not free.held_joints.any()
    # the thumb pushes the object: the reaction drives thumb_1 open, against its lower stop
    lower[j] = float(at.state.q[j])
    hand = dataclasses.replace(model.hand, joint_lower=lower)
    at_stop = KinematicModel(
        hand, model.obj, model.options, kinematics=model.kinematics, detector=model.detector
    )
    lin = at_stop.linearize(at.state, at.contacts)
    assert lin.held_joints.nonzero()[:, 0].tolist() == [j]
    assert float(lin.forces.stop_torque[j]) > 1e-3
    assert lin.joint_jacobian[j].abs().max() < 1e-12
    assert lin.object_jacobian[:, model.hand.actuator_names.index("thumb_proximal")].abs().max() < 1e-9
    # an upper stop at the same place cannot pull
    upper[j] = float(at.state.q[j])
    hand = dataclasses.replace(model.hand, joint_upper=upper)
    lin = KinematicModel(
        hand, model.obj, model.options, kinematics=model.kinematics, detector=model.detector
    ).linearize(at.state, at.contacts)
    assert not lin.held_joints.any()
    assert relative_error(lin.manipulation_jacobian, free.manipulation_jacobian, 20) < 1e-4


def test_how_much_a_stop_bears_is_told_by_the_fingertips():
    from equilibrium import EquilibriumSolver

    model, _, at = gripped("box", friction=6.0)  # pulling hard leaves the usual cones
    names = model.hand.joint_names
    j = names.index("thumb_2")

    def with_stop(lower):
        limits = model.hand.joint_lower.copy()
        limits[j] = lower
        hand = dataclasses.replace(model.hand, joint_lower=limits)
        # the state is exact: tangential forces are not to be held near 0
        options = dataclasses.replace(model.options, forces=ForceOptions(start_std=100.0))
        return KinematicModel(hand, model.obj, options, kinematics=model.kinematics, detector=model.detector)

    # 0.3 deg away from a stop it plays no part
    near = with_stop(float(at.state.q[j]) - 0.3 * DEG).linearize(at.state, at.contacts)
    assert not near.held_joints.any()
    assert (near.forces.mu - at.mu).norm() < 1e-4 * at.mu.norm()
    # pressed against it: hold the joint and pull; the other joint closes, this one would open
    solver = EquilibriumSolver(model, at.state, at.contacts, held=(j,))
    start = dataclasses.replace(at, stop=torch.zeros(1, dtype=F64))
    a = at.a.clone()
    a[model.hand.actuator_names.index("thumb_distal")] += 25 * DEG
    pressed = solver.move(start, a)
    assert float(pressed.stop[0]) > 0.02  # the stop pushes inwards
    # the toy contacts are named after links; name them after the pads
    pads = {pad.link: pad.name for pad in model.hand.pads}
    contacts = pressed.contacts.replace(finger=tuple(pads[link] for link in pressed.contacts.link))
    felt = torch.full((len(model.hand.pads),), float("nan"), dtype=F64)
    order = [pad.name for pad in model.hand.pads]
    felt[[order.index(name) for name in contacts.finger]] = solver.forces(pressed).normal
    lin = with_stop(float(at.state.q[j])).linearize(pressed.state, contacts, fingertip_force=felt)
    assert lin.held_joints.nonzero()[:, 0].tolist() == [j]
    assert float(lin.forces.stop_torque[j]) == pytest.approx(float(pressed.stop[0]), rel=2e-2)
    assert (lin.forces.mu - pressed.mu).norm() < 1e-2 * pressed.mu.norm()
    expected = finite_difference_jacobian(solver, pressed, 2e-4)
    assert relative_error(lin.manipulation_jacobian, expected, 20) < 1e-3
    with pytest.raises(ShapeError, match="fingertip_force"):
        model.linearize(at.state, contacts, fingertip_force=felt[:2])


def test_batch_equals_single_states():
    model, solver, at = gripped("box")
    states = list(noisy_states(at, 6, 1))
    contacts = [solver.surfaces(s.q, s.position, s.rotation) for s in states]
    stack = GraspState(
        torch.stack([s.q for s in states]).unflatten(0, (2, 3)),
        torch.stack([s.position for s in states]).unflatten(0, (2, 3)),
        torch.stack([s.rotation for s in states]).unflatten(0, (2, 3)),
    )
    fields = ("point", "normal", "gap", "finger_curvature", "object_curvature")
    batch = contacts[0].replace(
        **{name: torch.stack([getattr(c, name) for c in contacts]).unflatten(0, (2, 3)) for name in fields}
    )
    lin = model.linearize(stack, batch)
    assert lin.manipulation_jacobian.shape == (2, 3, 26, 9)
    for k, state in enumerate(states):
        single = model.linearize(state, contacts[k])
        i, j = divmod(k, 3)
        for name in (
            "manipulation_jacobian",
            "contact_force_sensitivity",
            "actuator_force_sensitivity",
            "normal_force_sensitivity",
            "margin_sensitivity",
            "stability",
        ):
            ours, theirs = getattr(lin, name)[i, j], getattr(single, name)
            assert (ours - theirs).norm() <= 1e-9 * theirs.norm() + 1e-12, name
    da = 0.01 * torch.ones(9, dtype=F64)
    moved = model(stack, da.expand(2, 3, 9), batch)
    assert torch.allclose(moved[1, 2], model(states[5], da, contacts[5]), atol=1e-12)
