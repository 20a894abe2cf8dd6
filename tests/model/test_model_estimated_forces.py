"""Contact forces from what fingertips, motors and the step before say."""

import dataclasses

import torch
from model_icub import gripped
from model_toys import F64, select

from torch_ekm.kinematics import GraspState


def noisy(state: GraspState, seed: int) -> GraspState:
    draw = torch.Generator().manual_seed(seed)
    return dataclasses.replace(state, q=state.q + 0.005 * torch.randn(20, generator=draw, dtype=F64))


def icub():
    model, solver, at = gripped("box")
    lin = model.linearize(at.state, at.contacts, forces=solver.forces(at))
    return model, at, lin


def test_true_forces_that_are_expected_are_kept_where_the_smallest_are_far_off():
    model, at, exact = icub()
    expected = exact.forces_after(torch.zeros(9, dtype=F64))
    smallest, kept = [], []
    for seed in range(5):
        state = noisy(at.state, seed)
        for errors, told in ((smallest, {}), (kept, {"expected": expected})):
            lin = model.linearize(state, at.contacts, **told)
            errors.append(float((lin.forces.force - exact.forces.force).norm()))
    expected = dataclasses.replace(expected, covariance=1e-4 * expected.covariance)
    sure = model.linearize(noisy(at.state, 0), at.contacts, expected=expected).forces
    assert float((sure.force - exact.forces.force).norm()) < 0.1 * kept[0]
    assert sum(kept) < 0.3 * sum(smallest)


def test_forces_follow_the_prediction_over_a_motion():
    """Two exact equilibria: what was expected after the motion is what comes, and the balance agrees."""
    model, solver, start = gripped("box")
    lin = model.linearize(start.state, start.contacts, forces=solver.forces(start))
    da = torch.zeros(9, dtype=F64)
    da[3:7] = torch.tensor([0.004, -0.003, 0.002, 0.003], dtype=F64)
    end = solver.move(start, start.a + da)
    after, true = lin.forces_after(da), solver.forces(end)
    assert float((after.force - true.force).norm()) < 0.03 * float((true.force - lin.forces.force).norm())
    assert torch.allclose(after.margin, true.margin, atol=2e-3)
    estimated = model.linearize(end.state, end.contacts, expected=after).forces
    assert float((estimated.force - true.force).norm()) < 5e-3


def test_fingertips_make_the_forces_surer():
    model, at, exact = icub()
    nothing = exact.forces_after(torch.zeros(9, dtype=F64))
    tips = torch.full((5,), torch.nan, dtype=F64)
    tips[:3] = exact.forces.normal
    told = ({}, {"fingertip_force": tips})
    sure = [
        model.linearize(at.state, at.contacts, expected=nothing, **what).forces.covariance for what in told
    ]
    assert float(sure[1].trace()) < float(sure[0].trace())
    assert model.linearize(at.state, at.contacts).forces.covariance is None  # a choice, not an estimate


def test_a_contact_that_was_not_expected_joins_in(toy):
    lin = toy.model.linearize(toy.state, forces=toy.forces())
    expected = lin.forces_after(torch.zeros(3, dtype=F64))
    fewer = select(toy.contacts, [0, 2])
    two = dataclasses.replace(
        expected,
        finger=fewer.finger,
        force=expected.force[[0, 2]],
        spin_moment=expected.spin_moment[[0, 2]],
        normal=expected.normal[[0, 2]],
        margin=expected.margin[[0, 2]],
        covariance=expected.covariance[:8, :8],
    )
    forces = toy.model.linearize(toy.state, expected=two).forces
    assert float((forces.force - lin.forces.force).norm()) < 0.2 * float(lin.forces.force.norm())
    swapped = dataclasses.replace(
        expected, finger=expected.finger[::-1], force=expected.force.flip(0), covariance=expected.covariance
    )
    again = toy.model.linearize(toy.state, expected=swapped).forces
    assert torch.allclose(
        again.force, toy.model.linearize(toy.state, expected=expected).forces.force, atol=1e-6
    )
