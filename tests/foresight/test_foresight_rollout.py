"""A rollout against exact equilibria, its derivatives, its batches."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import pytest
import torch
from turning import turning

from torch_ekm.control import DescribedFigures
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError, ShapeError
from torch_ekm.foresight import Rollout

sys.path.append(str(Path(__file__).parents[1] / "model"))
from model_icub import gripped

F64 = torch.float64
AXIS = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
DEG = math.pi / 180


def started(shape="box", **options):
    model, solver, at = gripped(shape, **options)
    return model, solver, at, model.linearize(at.state, at.contacts, forces=solver.forces(at))


def turned(shape, **options):
    """Exact equilibria of a turn of 20 deg in 12 motions, and the same foreseen."""
    model, solver, at, lin = started(shape, **options)
    exact, actions = [at], []
    for _ in range(12):
        here = exact[-1]
        now = model.linearize(here.state, here.contacts, forces=solver.forces(here))
        actions.append(turning(now, AXIS, 20 / 12 * DEG))
        exact.append(solver.move(here, here.a + actions[-1]))
    return (
        exact,
        [solver.forces(e) for e in exact],
        Rollout(model).predict(at.state, torch.stack(actions), start=lin),
    )


@pytest.mark.parametrize("shape", ["box", "can"])
def test_twenty_degrees_are_those_of_exact_equilibria(shape):
    exact, forces, foreseen = turned(shape, friction=20.0)  # no contact slips
    errors = torch.stack([foreseen.at(k).state.minus(e.state)[-6:] for k, e in enumerate(exact)])
    points = torch.stack([e.contacts.point for e in exact])
    assert float(exact[-1].state.minus(exact[0].state)[-3:] @ AXIS) > 20 * DEG
    assert (errors[:, 3:] @ AXIS).square().mean().sqrt() < 0.01 * DEG  # measured .002
    assert errors[:, :3].abs().max() < 1e-5  # measured 5e-6 [m]
    assert (
        foreseen.forces.force - torch.stack([f.force for f in forces])
    ).abs().max() < 0.01  # measured .005 [N]
    assert (foreseen.contacts.point - points).norm(dim=-1).max() < 2e-5  # measured 1e-5 [m]
    assert foreseen.first_slip is None


def test_the_first_slip_is_announced():
    _, forces, foreseen = turned("box")
    margins = torch.stack([f.margin for f in forces]).amin(-1)
    assert foreseen.first_slip == int((margins < 0).nonzero()[0]) > 1
    torch.testing.assert_close(foreseen.margin.amin(-1)[:2], margins[:2], rtol=0, atol=0.01)
    assert foreseen.margin.min() > -2.0  # a contact that slides begins the next motion on its cone


def test_a_half_as_long_motion_leaves_an_eighth_of_the_error():
    """Of one motion: the midpoint rule is of second order."""
    model, solver, at, lin = started()
    w = turning(lin, AXIS, 3 * DEG)
    errors = []
    for part in (1.0, 0.5):
        end = Rollout(model).predict(at.state, part * w[None], start=lin).end
        errors.append(end.minus(solver.move(at, at.a + part * w).state)[-6:].norm())
    assert 6 < errors[0] / errors[1] < 10


def test_batches_are_the_same_one_by_one():
    model, _, at, lin = started()
    rollout, generator = Rollout(model), torch.Generator().manual_seed(0)
    actions = 0.5 * DEG * torch.randn(2, 3, 2, model.hand.n_a, dtype=F64, generator=generator)
    together = rollout.predict(at.state, actions, start=lin)
    assert together.margin.shape == (2, 3, 3, 3)
    assert together.stability.shape == (2, 3, 3)
    for i, j in ((0, 0), (1, 2)):
        alone = rollout.predict(at.state, actions[i, j], start=lin)
        for name in ("normal_force", "margin", "stability"):
            torch.testing.assert_close(getattr(together, name)[i, j], getattr(alone, name), rtol=0, atol=1e-9)
        torch.testing.assert_close(together.end.position[i, j], alone.end.position, rtol=0, atol=1e-12)


def test_gradients_in_state_and_actions_are_those_of_differences():
    model, _, at, lin = started()
    rollout, generator = Rollout(model), torch.Generator().manual_seed(0)
    actions = DEG * torch.randn(2, model.hand.n_a, dtype=F64, generator=generator)
    force = torch.tensor([2.5, 1.25, 1.25], dtype=F64)

    def outcome(w, ds):
        start = rollout.kinematic.linearize(at.state.plus(ds), at.contacts, forces=lin.forces)
        p = rollout.predict(at.state.plus(ds), w, start=start)
        turned = p.turned(torch.eye(6, dtype=F64))[-1]
        return torch.cat([1e3 * turned, p.margin[-1] / force, p.end.q])

    ds = torch.zeros(at.state.n_s, dtype=F64)
    by_autograd = torch.autograd.functional.jacobian(outcome, (actions, ds))
    step = 1e-6
    for _ in range(3):
        dw = torch.randn(actions.shape, dtype=F64, generator=generator)
        dds = torch.randn(ds.shape, dtype=F64, generator=generator) * 0.01
        ends = [outcome(actions + sign * step * dw, ds + sign * step * dds) for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        expected = (by_autograd[0] * dw).sum((-2, -1)) + by_autograd[1] @ dds
        torch.testing.assert_close(slope, expected, rtol=1e-4, atol=1e-4)


def test_the_learner_moves_the_object_and_says_how_sure_it_is():
    model, _, at, lin = started()
    enhanced = EnhancedModel.for_grasp(model, at.state, figures=DescribedFigures())
    w = turning(lin, AXIS, 1 * DEG)
    actions = torch.stack([w, w])
    plain, unlearned = (Rollout(m).predict(at.state, actions, start=lin) for m in (model, enhanced))
    assert torch.equal(plain.states.position, unlearned.states.position)  # f + g == f before the first update
    assert plain.variance.abs().max() == 0
    assert bool((unlearned.variance[1:, -6:] > 0).all())
    assert bool((unlearned.variance[2, -6:] > unlearned.variance[1, -6:]).all())
    increment = 1.2 * lin.step(w)
    for _ in range(20):
        enhanced.update(at.state, w, increment, lin.step(w))
    learned = Rollout(enhanced).predict(at.state, actions, start=lin)
    first = learned.at(1).state.minus(at.state)[-6:]
    torch.testing.assert_close(first, increment[-6:], rtol=0.02, atol=2e-4)  # and what f changes on the way
    assert bool((learned.variance[1, -6:] < 0.2 * unlearned.variance[1, -6:]).all())


def test_a_grasp_that_buckles_on_the_way_is_reported_not_raised():
    model, _, at, lin = started()
    squeezed = dataclasses.replace(
        lin.forces, force=60 * lin.forces.force, normal=60 * lin.forces.normal, mu=60 * lin.forces.mu
    )
    hard = model.linearize(at.state, at.contacts, forces=squeezed, on_unstable="flag")
    still = torch.zeros(1, model.hand.n_a, dtype=F64)
    assert Rollout(model).predict(at.state, still, start=hard).stability[-1] < 0


def test_what_does_not_fit_is_refused():
    model, _, at, lin = started()
    rollout = Rollout(model)
    with pytest.raises(ShapeError, match="K, 9"):
        rollout.predict(at.state, torch.zeros(9, dtype=F64), start=lin)
    with pytest.raises(NonFiniteError):
        rollout.predict(at.state, torch.full((1, 9), math.nan, dtype=F64), start=lin)
