"""Whatever comes in: a typed answer, never NaN."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from missing_terms import without
from model_icub import gripped
from model_toys import F64, contact_set, planar_two_finger, relative_error, select, three_finger, toy_hand
from torch import nn

from torch_ekm.contact import ForceStatus
from torch_ekm.contact.contact_kinematics import constraint_matrix
from torch_ekm.exceptions import (
    NoContactError,
    NonFiniteError,
    ParameterError,
    PenetrationError,
    ShapeError,
    SingularGraspError,
    UnknownNameError,
    UnstableGraspError,
)
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelOptions, ModelStatus


def rebuilt(toy, *, options=None, contacts=None, **hand):
    model = toy.model
    contacts = toy.contacts if contacts is None else contacts
    return KinematicModel(
        dataclasses.replace(model.hand, **hand),
        model.obj,
        options or model.options,
        kinematics=model.kinematics,
        detector=lambda *_: contacts,
    )


def test_no_contacts():
    toy = three_finger()
    with pytest.raises(NoContactError, match="no finger"):
        rebuilt(toy, contacts=select(toy.contacts, [])).linearize(toy.state)


@pytest.mark.parametrize("on_unstable", ["raise", "flag"])
def test_a_motion_that_nothing_resists_is_an_error_whatever_the_option_says(on_unstable):
    toy = three_finger()
    options = dataclasses.replace(toy.model.options, on_unstable=on_unstable)
    with pytest.raises(SingularGraspError, match="a motion of the object") as caught:
        rebuilt(toy, contacts=select(toy.contacts, [0]), options=options).linearize(toy.state)
    assert caught.value.direction[-3:].norm() > 0.1


def test_two_hard_fingers_in_space_are_told_what_to_write():
    toy = three_finger()
    with pytest.raises(UnstableGraspError, match=r"^two hard fingers .* planar_normal, or torsional"):
        rebuilt(toy, contacts=select(toy.contacts, [0, 1])).linearize(toy.state)


def test_one_soft_contact_cannot_hold_but_the_answer_is_finite():
    toy = three_finger()
    soft = select(toy.contacts, [0]).replace(torsional_friction=torch.full((1,), 0.005, dtype=F64))
    with pytest.raises(UnstableGraspError) as caught:  # the object topples
        rebuilt(toy, contacts=soft).linearize(toy.state)
    assert caught.value.direction[-3:].norm() > 0.1
    flag = dataclasses.replace(toy.model.options, on_unstable="flag")
    lin = rebuilt(toy, contacts=soft, options=flag).linearize(toy.state)
    assert lin.status is ModelStatus.UNSTABLE
    assert lin.forces.status == (ForceStatus.NOT_GRASPABLE,)
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_coincident_contacts_on_one_link_change_nothing():
    toy = three_finger()
    twice = select(toy.contacts, [0, 1, 2, 2])
    J = toy.model.linearize(toy.state).manipulation_jacobian
    lin = rebuilt(toy, contacts=twice).linearize(toy.state)
    assert torch.isfinite(lin.manipulation_jacobian).all()
    assert relative_error(lin.manipulation_jacobian, J, 9) < 1e-6
    assert float(lin.forces.normal[2:].sum()) == pytest.approx(
        float(toy.model.linearize(toy.state).forces.normal[2])
    )


def test_an_object_that_cannot_be_held_says_so_and_the_step_leaves_out_the_forces():
    toy = three_finger()
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    lin = rebuilt(toy, contacts=slippery).linearize(toy.state)
    assert lin.status is ModelStatus.NO_FORCES
    assert lin.forces.status == (ForceStatus.NOT_GRASPABLE,)
    assert float(lin.forces.violation) > 0.05
    assert not lin.forces.solved
    for name in ("mu", "lam", "normal", "margin", "residual"):
        assert torch.isfinite(getattr(lin.forces, name)).all()
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_forces_of_the_previous_step_are_reused_for_the_same_contacts_only():
    toy = three_finger()
    model = toy.model
    good = model.linearize(toy.state)
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    again = model.linearize(toy.state, slippery, previous=good)
    assert again.status is ModelStatus.REUSED_FORCES
    assert torch.equal(again.forces.mu, good.forces.mu)
    assert relative_error(again.manipulation_jacobian, good.manipulation_jacobian, 9) < 1e-12
    assert model.linearize(toy.state, slippery).status is ModelStatus.NO_FORCES
    others = slippery.replace(finger=("a", "b", "c"))
    assert model.linearize(toy.state, others, previous=good).status is ModelStatus.NO_FORCES
    assert model.linearize(toy.state, slippery, previous=again).status is ModelStatus.NO_FORCES
    # what was found this time is used, whatever there was before
    known = model.linearize(toy.state, previous=again)
    assert torch.equal(known.manipulation_jacobian, good.manipulation_jacobian)


@pytest.mark.parametrize("batched", [False, True])
def test_forces_of_a_previous_step_stand_in_for_every_state_of_a_batch(batched):
    toy = three_finger()
    turn = torch.tensor([[0.0], [0.004]], dtype=F64)
    states = GraspState(
        toy.state.q + turn, toy.state.position.expand(2, 3), toy.state.rotation.expand(2, 3, 3)
    )
    fields = ("point", "normal", "gap", "finger_curvature", "object_curvature")

    def twice(contacts):
        return contacts.replace(**{name: torch.stack([getattr(contacts, name)] * 2) for name in fields})

    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    before = (states, twice(toy.contacts)) if batched else (toy.state, toy.contacts)
    previous = toy.model.linearize(*before)
    again = toy.model.linearize(states, twice(slippery), previous=previous)
    assert again.status is ModelStatus.REUSED_FORCES
    assert torch.equal(again.forces.mu, previous.forces.mu.expand(2, -1))
    assert torch.equal(again.forces.mu[0], again.forces.mu[1]) is not batched


def test_a_finger_through_the_object():
    toy = three_finger()
    deep = toy.contacts.replace(gap=torch.tensor([0.0, -0.02, 0.0], dtype=F64))
    with pytest.raises(PenetrationError, match="f1_l2") as caught:
        rebuilt(toy, contacts=deep).linearize(toy.state)
    assert caught.value.depth == pytest.approx(0.02)


def test_zero_springs_are_singular_unless_there_is_a_floor():
    toy = three_finger()
    with pytest.raises((SingularGraspError, UnstableGraspError)) as caught:
        rebuilt(toy, spring_stiffness=np.zeros(9)).linearize(toy.state)
    assert torch.isfinite(caught.value.direction).all()
    # a free finger without springs: a floor does not change what the object does
    model, solver, at = gripped("box")
    free = [k for k, name in enumerate(model.hand.joint_names) if name.startswith(("ring", "little"))]
    stiffness = model.hand.spring_stiffness.copy()
    stiffness[free] = 0.0
    hand = dataclasses.replace(model.hand, spring_stiffness=stiffness)
    args = {"kinematics": model.kinematics, "detector": model.detector}
    forces = solver.forces(at)
    with pytest.raises(SingularGraspError) as caught:
        KinematicModel(hand, model.obj, model.options, **args).linearize(at.state, at.contacts, forces=forces)
    ring_and_little = caught.value.direction
    assert ring_and_little is not None
    ours = []
    for floor in (1e-4, 2e-4):
        held = dataclasses.replace(hand, spring_stiffness=stiffness + floor * (stiffness == 0))
        lin = KinematicModel(held, model.obj, model.options, **args)
        ours.append(lin.linearize(at.state, at.contacts, forces=forces).object_jacobian)
    assert relative_error(ours[0], ours[1], 0) < 5e-3


def test_more_tendons_than_mobility():
    # planar two-finger grasp: 4 + 3 - 4 = 3 freedoms; four rigid tendons contradict each other
    toy = planar_two_finger()
    J_a = np.array([[0.009, 0.0, 0, 0], [0, 0.008, 0, 0], [0, 0, 0.009, 0], [0, 0, 0, 0.008]])
    hand = toy_hand(4, J_a, toy.model.hand.spring_stiffness, toy.model.hand.spring_rest, planar=(0, 0, 1.0))
    args = {"kinematics": toy.model.kinematics, "detector": toy.model.detector}
    options = toy.model.options
    with pytest.raises(SingularGraspError, match="actuator"):
        KinematicModel(hand, toy.model.obj, options, **args).linearize(toy.state)
    soft = toy_hand(
        4,
        J_a,
        toy.model.hand.spring_stiffness,
        toy.model.hand.spring_rest,
        planar=(0, 0, 1.0),
        stiffness=1e4,
    )
    lin = KinematicModel(soft, toy.model.obj, options, **args).linearize(toy.state)
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_a_grip_too_strong_buckles_and_the_model_without_geometry_does_not_see_it():
    toy = three_finger(grip=4.0)
    forces = toy.forces()
    with pytest.raises(UnstableGraspError, match="buckles") as caught:
        toy.model.linearize(toy.state, forces=forces)
    assert caught.value.stiffness < 0
    assert caught.value.direction.shape == (15,)
    A = constraint_matrix(toy.model.contact_kinematics(toy.state, toy.contacts))
    assert (A @ caught.value.direction).abs().max() < 1e-12  # the contacts allow it: state coordinates
    blind = without(toy.model, "S", "T", "rolling").linearize(toy.state, forces=forces)
    assert blind.status is ModelStatus.OK
    flag = dataclasses.replace(toy.model.options, on_unstable="flag")
    lin = rebuilt(toy, options=flag).linearize(toy.state, forces=forces)
    assert lin.status is ModelStatus.UNSTABLE
    assert float(lin.stability) < 0


def test_bad_input_is_named():
    toy = three_finger()
    model, state = toy.model, toy.state
    with pytest.raises(ShapeError, match="j8"):
        model.linearize(GraspState(state.q[:5], state.position, state.rotation))
    with pytest.raises(ShapeError, match="delta_a"):
        model(state, torch.zeros(4, dtype=F64))
    with pytest.raises(NonFiniteError, match=r"contacts\.point"):
        model.linearize(state, toy.contacts.replace(point=toy.contacts.point * float("nan")))
    with pytest.raises(UnknownNameError, match="f9"):
        model.linearize(state, toy.contacts.replace(link=("f9", "f9", "f9")))
    batch = GraspState(*(x.expand(2, *x.shape) for x in (state.q, state.position, state.rotation)))
    with pytest.raises(ShapeError, match="contacts"):
        model.linearize(batch)
    with pytest.raises(ShapeError, match="gap"):
        model.linearize(batch, toy.contacts)


@pytest.mark.parametrize(
    "bad",
    [
        {"max_overlap": 0.0},
        {"on_unstable": "ignore"},
        {"contact_margin": -1.0},
    ],
)
def test_bad_options_are_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        ModelOptions(**bad)


def test_it_is_a_module_that_moves_and_copies():
    import copy

    toy = three_finger()
    model = copy.deepcopy(toy.model)
    assert isinstance(model, nn.Module)
    lin = toy.model.linearize(toy.state)
    assert torch.equal(model.linearize(toy.state).manipulation_jacobian, lin.manipulation_jacobian)
    assert "n_a=3" in repr(model)
    assert lin.margins.shape == (3,)
    assert lin.normal_rows == (0, 3, 6)


def test_float32():
    toy = three_finger()
    c = toy.contacts
    f32 = {
        name: getattr(c, name).float()
        for name in ("point", "normal", "gap", "finger_curvature", "object_curvature", "friction")
    }
    contacts = c.replace(torsional_friction=c.torsional_friction.float(), **f32)

    class Single(nn.Module):
        def __init__(self, inner):
            super().__init__()
            self.inner, self.link_names = inner, inner.link_names
            self.dtype = torch.float32
            self.register_buffer("upstream", inner.upstream)

        def forward(self, q):
            poses = self.inner(q.double())
            return dataclasses.replace(poses, transforms=poses.transforms.float())

        def joint_axes(self, poses):
            double = dataclasses.replace(poses, transforms=poses.transforms.double())
            axis, origin = self.inner.joint_axes(double)
            return axis.float(), origin.float()

    model = KinematicModel(
        toy.model.hand,
        toy.model.obj,
        toy.model.options,
        kinematics=Single(toy.model.kinematics),
        detector=lambda *_: contacts,
        dtype=torch.float32,
    )
    state = GraspState(toy.state.q.float(), toy.state.position.float(), toy.state.rotation.float())
    lin = model.linearize(state)
    assert lin.manipulation_jacobian.dtype == torch.float32
    J = toy.model.linearize(toy.state).manipulation_jacobian
    assert relative_error(lin.manipulation_jacobian.double(), J, 9) < 1e-3


def test_contact_set_helper_is_what_the_tests_think():
    c = contact_set(["a"], [[0.0, 0, 0]], [[0.0, 0, 1.0]], 100.0, 0.0)
    assert torch.allclose(
        torch.linalg.eigvalsh(c.finger_curvature)[0], torch.tensor([0.0, 100, 100], dtype=F64)
    )
