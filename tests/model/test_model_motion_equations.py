"""J_m with other figures of the hand, and its derivative in closed form."""

from __future__ import annotations

import copy

import pytest
import torch
from model_icub import gripped
from model_toys import planar_two_finger, soft_two_finger, three_finger

from torch_ekm.model.reduction import Drives

F64 = torch.float64


def icub():
    model, _, at = gripped("box")
    model = copy.copy(model)
    model.detector = lambda *_: at.contacts
    return model, at.state


def toy(make, **options):
    grasp = make(**options)
    return grasp.model, grasp.state


GRASPS = {
    "iCub": icub,
    "planar": lambda: toy(planar_two_finger),
    "rigid tendons": lambda: toy(three_finger),
    "compliant tendons": lambda: toy(three_finger, stiffness=2e4),
    "soft fingers": lambda: toy(soft_two_finger),
}


def others(model):
    """Figures that are not the described ones, and carry a derivative."""
    draw = torch.Generator().manual_seed(4)

    def near(value):
        factor = 1 + 0.2 * torch.rand(value.shape, generator=draw, dtype=F64)
        return (value * factor).where(value.isfinite(), value).requires_grad_(True)

    springs = near(model.spring_stiffness)
    return springs, near(model.reduction.actuation), near(model.reduction.stiffness)


def jacobian(lin, model, springs, arms, stiffness):
    return lin.equations.solve(springs - model.spring_stiffness, Drives(arms, stiffness))


@pytest.mark.parametrize("name", GRASPS)
def test_described_figures_give_the_same_jacobian(name) -> None:
    model, state = GRASPS[name]()
    lin = model.linearize(state)
    same = lin.equations.solve(torch.zeros(model.hand.n_q, dtype=F64), model.reduction.drives)
    torch.testing.assert_close(same.jacobian, lin.manipulation_jacobian, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", GRASPS)
def test_the_closed_form_is_the_derivative_by_autograd(name) -> None:
    model, state = GRASPS[name]()
    lin = model.linearize(state)
    figures = others(model)
    moved = 0.1 * torch.randn(model.hand.n_a, generator=torch.Generator().manual_seed(1), dtype=F64)
    rows = [0, 1, *range(model.hand.n_q, model.hand.n_q + 6)]
    motion = jacobian(lin, model, *figures)
    ds = (motion.jacobian @ moved)[rows]
    with torch.no_grad():
        found = jacobian(lin, model, *figures).derivative(moved, rows)
    for value, mine in zip(figures, found, strict=True):
        exact = torch.stack([
            torch.autograd.grad(one, value, retain_graph=True, materialize_grads=True, allow_unused=True)[0]
            for one in ds
        ])  # fmt: skip
        exact = exact.where(value.isfinite(), 0.0)  # rigid actuators
        if value.dim() == 2:  # arms that are not there have a derivative, too
            assert mine.abs().max() > 0
        torch.testing.assert_close(mine, exact, rtol=1e-9, atol=1e-12 + 1e-9 * float(exact.abs().max()))


def test_forces_and_what_is_held_stay_those_of_the_description() -> None:
    model, state = icub()
    lin = model.linearize(state)
    other = model.spring_stiffness.new_ones(model.hand.n_q)
    moved = lin.equations.solve(other, model.reduction.drives).jacobian
    again = model.linearize(state)
    assert float((moved - lin.manipulation_jacobian).abs().max()) > 1e-3
    assert torch.equal(again.forces.force, lin.forces.force)
