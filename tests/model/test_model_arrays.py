"""One state is computed in numpy, batches and derivatives in torch, by the same equations."""

from __future__ import annotations

import dataclasses
import functools

import pytest
import torch
from model_icub import gripped
from model_toys import planar_two_finger, soft_two_finger, three_finger

from torch_ekm.contact.contact_set import VARYING
from torch_ekm.estimation.hand_figures import HandFigures
from torch_ekm.kinematics import GraspState

F64 = torch.float64


def icub():
    model, _, at = gripped("box")
    return model, at.state, at.contacts


def toy(make, **options):
    grasp = make(**options)
    return grasp.model, grasp.state, grasp.contacts


GRASPS = {
    "iCub": icub,
    "planar": lambda: toy(planar_two_finger),
    "rigid tendons": lambda: toy(three_finger),
    "compliant tendons": lambda: toy(three_finger, stiffness=2e4),
    "soft fingers": lambda: toy(soft_two_finger),
}


def in_batch(state, contacts):
    """The same state as a batch of one, which torch computes."""
    many = GraspState(state.q[None], state.position[None], state.rotation[None])
    return many, contacts.replace(**{name: getattr(contacts, name)[None] for name in VARYING})


def assert_same(one, many, names=None):
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(many, field.name)
        if isinstance(a, torch.Tensor) and (names is None or field.name in names):
            message = functools.partial("{}: {}".format, field.name)
            torch.testing.assert_close(a, b[0], rtol=1e-10, atol=1e-10, msg=message)


@pytest.mark.parametrize("name", GRASPS)
def test_a_state_in_numpy_is_the_state_in_torch(name) -> None:
    model, state, contacts = GRASPS[name]()
    n_a = model.hand.n_a
    da = 0.01 * torch.arange(1, n_a + 1).to(F64)
    one, many = model.linearize(state, contacts), model.linearize(*in_batch(state, contacts))
    for _ in range(2):  # with nothing known of the forces, and with those that are expected
        assert one.forces.status == many.forces.status
        assert [doubt.kind for doubt in one.doubts] == [doubt.kind for doubt in many.doubts]
        assert_same(one.forces, many.forces)
        fields = {field.name for field in dataclasses.fields(one)} - {"described"}
        assert_same(one, many, fields)
        assert_same(one.forces_after(da), many.forces_after(da[None]))
        torch.testing.assert_close(one.margins_after(da), many.margins_after(da[None])[0], rtol=0, atol=1e-10)
        expected = one.forces_after(0 * da)
        one = model.linearize(state, contacts, expected=expected, previous=one)
        many = model.linearize(*in_batch(state, contacts), expected=expected, previous=many)


@pytest.mark.parametrize("name", ["iCub", "rigid tendons"])
def test_figures_in_numpy_are_the_figures_in_torch(name) -> None:
    model, state, contacts = GRASPS[name]()
    if name == "iCub":
        figures = HandFigures.of(model.hand)
        draw = torch.Generator().manual_seed(2)
        figures.mean.copy_(0.3 * torch.randn(len(figures), generator=draw).double())
        springs, drives = figures.present(model.reduction.drives)
    else:  # rigid: the null space of the description does not hold for other moment arms
        springs, drives = 0.1 * model.spring_stiffness, model.reduction.drives
        drives = drives._replace(actuation=1.1 * drives.actuation)
    equations = model.linearize(state, contacts).equations
    ours = equations.solve(springs, drives)
    torchs = equations.solve(springs.clone().requires_grad_(True), drives)
    assert torchs.jacobian.requires_grad
    torch.testing.assert_close(ours.jacobian, torchs.jacobian.detach(), rtol=0, atol=1e-11)
