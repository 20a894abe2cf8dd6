"""J_m with other figures of the hand, and its derivative in closed form."""

from __future__ import annotations

import pytest
import torch
from model_icub import GRASPS
from model_toys import F64

from torch_ekm.model.reduction import Drives


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
def test_the_closed_form_is_the_derivative_by_autograd(name) -> None:
    """In numpy, whose Jacobian is that which torch differentiates, and J_m for the described figures."""
    model, state, _ = GRASPS[name]()
    lin = model.linearize(state)
    same = lin.equations.solve(torch.zeros(model.hand.n_q, dtype=F64), model.reduction.drives)
    torch.testing.assert_close(same.jacobian, lin.manipulation_jacobian, rtol=0, atol=1e-13)
    figures = others(model)
    moved = 0.1 * torch.randn(model.hand.n_a, generator=torch.Generator().manual_seed(1), dtype=F64)
    rows = [0, 1, *range(model.hand.n_q, model.hand.n_q + 6)]
    motion = jacobian(lin, model, *figures)
    ds = (motion.jacobian @ moved)[rows]
    ours = jacobian(lin, model, *(value.detach() for value in figures))
    torch.testing.assert_close(ours.jacobian, motion.jacobian.detach(), rtol=0, atol=1e-11)
    found = ours.derivative(moved, rows)
    for value, mine in zip(figures, found, strict=True):
        exact = torch.stack([
            torch.autograd.grad(one, value, retain_graph=True, materialize_grads=True, allow_unused=True)[0]
            for one in ds
        ])  # fmt: skip
        exact = exact.where(value.isfinite(), 0.0)  # rigid actuators
        if value.dim() == 2:  # arms that are not there have a derivative, too
            assert mine.abs().max() > 0
        torch.testing.assert_close(mine, exact, rtol=1e-9, atol=1e-12 + 1e-9 * float(exact.abs().max()))
