"""The iCub hand itself in a three-finger pinch of a box: noise, joints at their stops; batches."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from equilibrium import EquilibriumSolver
from model_icub import DEG, GRASPS, gripped
from model_toys import F64, batch_of, changed, finite_difference_jacobian, relative_error, stacked

from torch_ekm.contact import ForceOptions
from torch_ekm.contact.contacts import SHARED, VARYING
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel


def noisy_states(at, draws, seed):
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([0.5 * DEG] * 20 + [0.5e-3] * 3 + [0.5 * DEG] * 3, dtype=F64)
    for _ in range(draws):
        yield at.state.plus(size * torch.randn(26, dtype=F64, generator=generator))


def test_with_noise_forces_are_found_and_the_jacobian_stays_near():
    model, solver, at = gripped("box")
    exact = model.linearize(at.state, at.contacts, forces=solver.forces(at)).manipulation_jacobian
    model, errors = changed(model, options={"on_unstable": "flag"}), []
    for state in noisy_states(at, 30, 0):
        contacts = solver.surfaces(state.q, state.position, state.rotation)
        lin = model.linearize(state, contacts)
        assert lin.forces.solved
        assert float(lin.forces.margin.min()) > -1e-6
        errors.append(relative_error(lin.manipulation_jacobian, exact, 20))
    assert np.median(errors) < 0.15


def test_float32():
    model, _, at = gripped("box")
    parts = {name: getattr(at.contacts, name).float() for name in (*VARYING, *SHARED)}
    state = GraspState(at.state.q.float(), at.state.position.float(), at.state.rotation.float())
    kinematics = HandKinematics(model.hand, dtype=torch.float32)
    options = {"kinematics": kinematics, "detector": model.detector, "dtype": torch.float32}
    lin = KinematicModel(model.hand, model.obj, **options).linearize(state, at.contacts.replace(**parts))
    assert lin.manipulation_jacobian.dtype == torch.float32
    J = model.linearize(at.state, at.contacts).manipulation_jacobian
    assert relative_error(lin.manipulation_jacobian.double(), J, 20) < 1e-3


def test_a_joint_at_its_stop_is_held_and_a_pull_away_from_it_is_not():
    model, solver, at = gripped("box")
    forces = solver.forces(at)
    free = model.linearize(at.state, at.contacts, forces=forces)
    j = model.hand.joint_names.index("thumb_1")
    lower, upper = model.hand.joint_lower.copy(), model.hand.joint_upper.copy()
    assert not free.held_joints.any()
    # the thumb pushes the object: the reaction drives thumb_1 open, against its lower stop
    lower[j] = float(at.state.q[j])
    lin = changed(model, joint_lower=lower).linearize(at.state, at.contacts)
    assert lin.held_joints.nonzero()[:, 0].tolist() == [j]
    assert float(lin.forces.stop_torque[j]) > 1e-3
    assert lin.joint_jacobian[j].abs().max() < 1e-12
    assert lin.object_jacobian[:, model.hand.actuator_names.index("thumb_proximal")].abs().max() < 1e-9
    # an upper stop at the same place cannot pull
    upper[j] = float(at.state.q[j])
    lin = changed(model, joint_upper=upper).linearize(at.state, at.contacts)
    assert not lin.held_joints.any()
    assert relative_error(lin.manipulation_jacobian, free.manipulation_jacobian, 20) < 1e-4


def test_how_much_a_stop_bears_is_told_by_the_fingertips():
    model, _, at = gripped("box", friction=6.0)  # pulling hard leaves the usual cones
    names = model.hand.joint_names
    j = names.index("thumb_2")

    def with_stop(lower):
        limits = model.hand.joint_lower.copy()
        limits[j] = lower
        # the state is exact: tangential forces are not to be held near 0
        return changed(model, options={"forces": ForceOptions(start_std=100.0)}, joint_lower=limits)

    # 0.3 deg away from a stop it plays no part
    near = with_stop(float(at.state.q[j]) - 0.3 * DEG).linearize(at.state, at.contacts)
    assert not near.held_joints.any()
    assert (near.forces.mu - at.mu).norm() < 1e-4 * at.mu.norm()
    # pressed against it: hold the joint and pull; the other joint closes, this one would open
    solver = EquilibriumSolver(model, at.state, at.contacts, held=(j,), max_step=0.2)
    start = dataclasses.replace(at, stop=torch.zeros(1, dtype=F64))
    a = at.a.clone()
    a[model.hand.actuator_names.index("thumb_distal")] += 25 * DEG
    pressed = solver.move(start, a)
    assert float(pressed.stop[0]) > 0.02  # the stop pushes inwards
    felt = torch.full((5,), torch.nan, dtype=F64)
    felt[:3] = solver.forces(pressed).normal
    lin = with_stop(float(at.state.q[j])).linearize(pressed.state, pressed.contacts, fingertip_force=felt)
    assert lin.held_joints.nonzero()[:, 0].tolist() == [j]
    assert float(lin.forces.stop_torque[j]) == pytest.approx(float(pressed.stop[0]), rel=2e-2)
    assert (lin.forces.mu - pressed.mu).norm() < 1e-2 * pressed.mu.norm()
    expected = finite_difference_jacobian(solver, pressed, 2e-4)
    assert relative_error(lin.manipulation_jacobian, expected, 20) < 1e-3


def assert_same(one, many, k):
    """A state's answer is the k-th of a batch."""
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(many, field.name)
        if isinstance(a, torch.Tensor) and field.name != "described":
            message = functools.partial("{}: {}".format, field.name)
            torch.testing.assert_close(a, b[k], rtol=1e-9, atol=1e-9, msg=message)


@pytest.mark.parametrize("name", GRASPS)
def test_a_state_in_numpy_is_the_state_in_torch(name) -> None:
    """Two states, which torch computes as a batch."""
    model, state, contacts = GRASPS[name]()
    n_a = model.hand.n_a
    da = 0.01 * torch.arange(1, n_a + 1).to(F64)
    states = state, state.plus(torch.full((state.n_s,), 2e-4, dtype=F64))
    batch = batch_of(*states), stacked(contacts, contacts)
    ones, many = [model.linearize(one, contacts) for one in states], model.linearize(*batch)
    for _ in range(2):  # with nothing known of the forces, and with those that are expected
        assert many.forces.status == sum((one.forces.status for one in ones), ())
        assert {doubt.kind for doubt in many.doubts} == {doubt.kind for one in ones for doubt in one.doubts}
        after, margins = many.forces_after(da.expand(2, -1)), many.margins_after(da.expand(2, -1))
        for k, one in enumerate(ones):
            assert_same(one.forces, many.forces, k)
            assert_same(one, many, k)
            assert_same(one.forces_after(da), after, k)
            torch.testing.assert_close(one.margins_after(da), margins[k], rtol=0, atol=1e-9)
        expected = [one.forces_after(0 * da) for one in ones]
        every = many.forces_after(0 * da.expand(2, -1))
        ones = [
            model.linearize(state, contacts, expected=known, previous=one)
            for state, known, one in zip(states, expected, ones, strict=True)
        ]
        many = model.linearize(*batch, expected=every, previous=many)
    moved = model(batch[0], da.expand(2, -1), batch[1])
    for k, state in enumerate(states):
        torch.testing.assert_close(moved[k], model(state, da, contacts), rtol=0, atol=1e-9)
