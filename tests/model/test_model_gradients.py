"""The derivative of J_m by figures of the hand, in closed form; J_m as a function of the state has none."""

import dataclasses

import pytest
import torch
from model_icub import GRASPS
from model_toys import F64

from torch_ekm.exceptions import ParameterError
from torch_ekm.model.reduction import Drives


def others(model):
    """Figures that are not the described ones."""
    draw = torch.Generator().manual_seed(4)

    def near(value):
        factor = 1 + 0.2 * torch.rand(value.shape, generator=draw, dtype=F64)
        return (value * factor).where(value.isfinite(), value)

    springs = near(model.spring_stiffness)
    return springs, near(model.reduction.actuation), near(model.reduction.stiffness)


def jacobian(lin, model, springs, arms, stiffness):
    return lin.equations.solve(springs - model.spring_stiffness, Drives(arms, stiffness))


@pytest.mark.parametrize("name", GRASPS)
def test_the_closed_form_is_the_derivative_by_differences(name) -> None:
    """And J_m for the described figures."""
    model, state, _ = GRASPS[name]()
    lin = model.linearize(state)
    same = lin.equations.solve(torch.zeros(model.hand.n_q, dtype=F64), model.reduction.drives)
    torch.testing.assert_close(same.jacobian, lin.manipulation_jacobian, rtol=0, atol=1e-13)
    figures = others(model)
    moved = 0.1 * torch.randn(model.hand.n_a, generator=torch.Generator().manual_seed(1), dtype=F64)
    rows = [0, 1, *range(model.hand.n_q, model.hand.n_q + 6)]
    found = jacobian(lin, model, *figures).derivative(moved, rows)
    for k, (value, mine) in enumerate(zip(figures, found, strict=True)):
        for index in value.nonzero().tolist():
            here = value[tuple(index)]
            if not torch.isfinite(here):
                continue  # a rigid actuator
            ends, h = [], 1e-5 * float(here.abs())
            for sign in (1, -1):
                changed = value.clone()
                changed[tuple(index)] += sign * h
                at = (*figures[:k], changed, *figures[k + 1 :])
                ends.append((jacobian(lin, model, *at).jacobian @ moved)[rows])
            exact = (ends[0] - ends[1]) / (2 * h)
            ours = mine[(slice(None), *index)]
            torch.testing.assert_close(ours, exact, rtol=1e-5, atol=1e-9 + 1e-5 * float(mine.abs().max()))


def test_a_state_that_asks_for_a_gradient_is_refused() -> None:
    model, state, _ = next(iter(GRASPS.values()))()
    with pytest.raises(ParameterError, match="detached"):
        model.linearize(dataclasses.replace(state, q=state.q.clone().requires_grad_()))
