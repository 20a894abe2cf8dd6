"""Derivatives of J_m and of the forces with respect to figures of the hand and to the state."""

from __future__ import annotations

import copy

import pytest
import torch
from model_icub import gripped, pinch
from model_toys import planar_two_finger, soft_two_finger, three_finger

from torch_ekm.kinematics import GraspState

F64 = torch.float64
WISHED = torch.tensor([2.5, 1.2, 1.3], dtype=F64)  # measured normal forces [N]


def icub(**options):
    model, _, at = gripped("box", **options)
    model = copy.copy(model)  # the fixture's is kept for other tests
    model.detector = lambda *_: at.contacts
    pads = [pad.name for pad in model.hand.pads]
    measured = torch.full((len(pads),), float("nan"), dtype=F64)
    for name, force in zip(("thumb", "index", "middle"), WISHED, strict=True):
        measured[pads.index(name)] = force
    contacts = at.contacts.replace(finger=("thumb", "index", "middle"))
    model.detector = lambda *_: contacts
    return model, at.state, measured


def icub_at_the_friction_cone():
    model, state, _ = pinch("box", friction=0.25)
    return model, state, None


def toy(make, **options):
    grasp = make(**options)
    return grasp.model, grasp.state, None


GRASPS = {
    "iCub": icub,
    "iCub, friction active": icub_at_the_friction_cone,
    "planar": lambda: toy(planar_two_finger),
    "rigid tendons": lambda: toy(three_finger),
    "compliant tendons": lambda: toy(three_finger, stiffness=2e4),
    "soft fingers": lambda: toy(soft_two_finger),
}
BUFFERS = ("spring_stiffness", "spring_rest", "reduction.actuation", "reduction.stiffness", "com")


@pytest.fixture(autouse=True)
def _exact_force_problems(monkeypatch):
    """PIQP's usual tolerance leaves 3e-4 of the weakest direction: finite differences need it tighter."""
    import qpsolvers

    solve = qpsolvers.solve_problem

    def tight(problem, solver, **options):
        options |= {"eps_abs": 1e-13, "eps_rel": 1e-13} if solver == "piqp" else {}
        return solve(problem, solver, **options)

    monkeypatch.setattr(qpsolvers, "solve_problem", tight)


def outputs(model, state, measured=None):
    """Weighted sums of J_m, of the contact forces and of the joint residual."""
    lin = model.linearize(state, fingertip_force=measured)
    parts = (lin.manipulation_jacobian, lin.forces.mu, lin.forces.residual, lin.forces.lam)
    sums = []
    for part in parts:
        weight = torch.randn(part.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
        sums.append((weight * part).sum())
    return torch.stack(sums)


@pytest.mark.parametrize("name", GRASPS)
def test_derivative_by_the_figures_of_the_hand(name):
    model, state, measured = GRASPS[name]()
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
    from torch_ekm.contact import ContactDetector
    from torch_ekm.description import load_object
    from torch_ekm.model import KinematicModel

    toy_model, _, at = gripped("box")
    box = load_object("box")
    detector = ContactDetector(toy_model.hand, box, margin=0.02, kinematics=toy_model.kinematics)
    model = KinematicModel(
        toy_model.hand, box, toy_model.options, kinematics=toy_model.kinematics, detector=detector
    )
    measured = torch.full((5,), float("nan"), dtype=F64)
    measured[:3] = WISHED

    def of(ds):
        return outputs(model, at.state.plus(ds), measured)

    ds = torch.zeros(at.state.n_s, dtype=F64, requires_grad=True)
    gradients = torch.stack([torch.autograd.grad(y, ds, retain_graph=True)[0] for y in of(ds)])
    for j in (1, 3, 7, 20, 21, 22, 23, 24, 25):
        step = torch.zeros(at.state.n_s, dtype=F64)
        step[j] = 2e-6
        expected = (of(step) - of(-step)) / 4e-6
        assert ((gradients[:, j] - expected).abs() / gradients.abs().amax(1)).max() < 2e-3, j


def test_nothing_is_recorded_unless_it_is_asked_for():
    model, state, measured = icub()
    lin = model.linearize(state, fingertip_force=measured)
    assert not lin.manipulation_jacobian.requires_grad
    model.spring_stiffness.requires_grad_(True)
    with torch.no_grad():
        assert not model.linearize(state).manipulation_jacobian.requires_grad
    with_graph = model.linearize(state, fingertip_force=measured)
    assert with_graph.manipulation_jacobian.requires_grad
    model.spring_stiffness.requires_grad_(False)
    torch.testing.assert_close(
        with_graph.manipulation_jacobian.detach(), lin.manipulation_jacobian, rtol=1e-9, atol=1e-12
    )
    torch.testing.assert_close(with_graph.forces.mu.detach(), lin.forces.mu, rtol=0, atol=1e-12)


def test_a_batch_has_the_derivatives_of_its_states():
    model, state, _ = icub()
    contacts = model.contacts(state)
    names = ("point", "normal", "gap", "finger_curvature", "object_curvature")

    def twice(x):
        return torch.stack([x, x])

    both = contacts.replace(**{name: twice(getattr(contacts, name)) for name in names})
    batch = GraspState(twice(state.q), twice(state.position), twice(state.rotation))
    model.spring_stiffness.requires_grad_(True)
    one = torch.autograd.grad(model.linearize(state).manipulation_jacobian.sum(), model.spring_stiffness)[0]
    two = torch.autograd.grad(
        model.linearize(batch, both).manipulation_jacobian.sum(), model.spring_stiffness
    )[0]
    model.spring_stiffness.requires_grad_(False)
    torch.testing.assert_close(two, 2 * one, rtol=1e-8, atol=1e-8)
