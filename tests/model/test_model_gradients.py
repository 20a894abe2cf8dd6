"""Derivatives of J_m and of the forces by figures of the hand and by the state; in closed form, too."""

from __future__ import annotations

import pytest
import torch
from model_icub import GRASPS, icub, pinch
from model_toys import F64, batch_of, changed, stacked

from torch_ekm.contact import ContactDetector
from torch_ekm.description import load_object
from torch_ekm.model.reduction import Drives

#: Normal forces that thumb, index and middle finger measure [N].
MEASURED = torch.tensor([2.5, 1.2, 1.3, torch.nan, torch.nan], dtype=F64)
CASES = {
    **{name: (make, MEASURED if name == "iCub" else None) for name, make in GRASPS.items()},
    "iCub, friction active": (lambda: pinch("box", friction=0.25), None),
}
BUFFERS = ("spring_stiffness", "spring_rest", "reduction.actuation", "reduction.stiffness", "com")


pytestmark = pytest.mark.usefixtures("exact_force_problems")


def outputs(model, state, measured=None):
    """Weighted sums of J_m, of the contact forces and of the joint residual."""
    lin = model.linearize(state, fingertip_force=measured)
    parts = (lin.manipulation_jacobian, lin.forces.mu, lin.forces.residual, lin.forces.lam)
    sums = []
    for part in parts:
        weight = torch.randn(part.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
        sums.append((weight * part).sum())
    return torch.stack(sums)


@pytest.mark.parametrize("name", CASES)
def test_derivative_by_the_figures_of_the_hand(name):
    make, measured = CASES[name]
    model, state, _ = make()
    for path in BUFFERS:
        buffer = model.get_buffer(path)
        if not torch.isfinite(buffer).all():
            continue  # rigid
        buffer.requires_grad_(True)
        graph = outputs(model, state, measured)
        gradients = [
            torch.autograd.grad(y, buffer, retain_graph=True, allow_unused=True)[0]
            if y.requires_grad
            else None
            for y in graph
        ]
        gradients = [torch.zeros_like(buffer) if g is None else g for g in gradients]
        buffer.requires_grad_(False)
        touched = torch.nonzero(buffer if path == "reduction.actuation" else torch.ones_like(buffer))
        for index in map(tuple, touched[:: max(1, len(touched) // 6)].tolist()):
            here = buffer[index].clone()
            step = 1e-5 * max(float(here.abs()), 1e-2)
            ends = []
            for sign in (1, -1):
                buffer[index] = here + sign * step
                ends.append(outputs(model, state, measured))
            buffer[index] = here
            expected = (ends[0] - ends[1]) / (2 * step)
            actual = torch.stack([g[index] for g in gradients])
            size = torch.stack([g.abs().max() for g in gradients]) + 1e-3 * graph.detach().abs() + 1e-6
            assert ((actual - expected).abs() / size).max() < 2e-4, (path, index, actual, expected)


def test_derivative_by_the_state_contacts_from_the_detector():
    pytest.importorskip("coal")
    model, state, _ = icub()
    box = load_object("box")
    detector = ContactDetector(model.hand, box, margin=0.02, kinematics=model.kinematics)
    model = changed(model, obj=box)
    model.detector = detector

    def of(ds):
        return outputs(model, state.plus(ds), MEASURED)

    ds = torch.zeros(state.n_s, dtype=F64, requires_grad=True)
    gradients = torch.stack([torch.autograd.grad(y, ds, retain_graph=True)[0] for y in of(ds)])
    for j in (1, 3, 7, 20, 21, 22, 23, 24, 25):
        step = torch.zeros(state.n_s, dtype=F64)
        step[j] = 2e-6
        expected = (of(step) - of(-step)) / 4e-6
        assert ((gradients[:, j] - expected).abs() / gradients.abs().amax(1)).max() < 2e-3, j


def test_nothing_is_recorded_unless_it_is_asked_for():
    model, state, _ = icub()
    lin = model.linearize(state, fingertip_force=MEASURED)
    assert not lin.manipulation_jacobian.requires_grad
    model.spring_stiffness.requires_grad_(True)
    with torch.no_grad():
        assert not model.linearize(state).manipulation_jacobian.requires_grad
    with_graph = model.linearize(state, fingertip_force=MEASURED)
    ours, theirs = with_graph.manipulation_jacobian, lin.manipulation_jacobian
    assert ours.requires_grad
    torch.testing.assert_close(ours.detach(), theirs, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(with_graph.forces.mu.detach(), lin.forces.mu, rtol=0, atol=1e-12)


def test_a_batch_has_the_derivatives_of_its_states():
    model, state, contacts = icub()
    model.spring_stiffness.requires_grad_(True)

    def slope(*at):
        total = model.linearize(*at).manipulation_jacobian.sum()
        return torch.autograd.grad(total, model.spring_stiffness)[0]

    twice = slope(batch_of(state, state), stacked(contacts, contacts))
    torch.testing.assert_close(twice, 2 * slope(state), rtol=1e-8, atol=1e-8)


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
