"""Whatever comes in: a typed answer, never NaN, and the same one whatever the axes."""

import dataclasses

import numpy as np
import pytest
import torch
from model_icub import gripped
from model_toys import (
    F64,
    ChainKinematics,
    batch_of,
    changed,
    planar_two_finger,
    relative_error,
    select,
    stacked,
    three_finger,
)

from torch_ekm.contact import ForceStatus
from torch_ekm.contact.contacts import constraint_matrix
from torch_ekm.exceptions import NoContactError, PenetrationError, SingularGraspError, UnstableGraspError
from torch_ekm.kinematics import GraspState
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel, ModelStatus
from torch_ekm.model.reduction import two_stage


def test_no_contacts(toy):
    with pytest.raises(NoContactError, match="no finger"):
        changed(toy.model, contacts=select(toy.contacts, [])).linearize(toy.state)


@pytest.mark.parametrize("on_unstable", ["raise", "flag"])
def test_a_motion_that_nothing_resists_is_an_error_whatever_the_option_says(toy, on_unstable):
    one = changed(toy.model, contacts=select(toy.contacts, [0]), options={"on_unstable": on_unstable})
    with pytest.raises(SingularGraspError, match=r"a motion of the object .* leave it free") as caught:
        one.linearize(toy.state)
    assert caught.value.direction[-3:].norm() > 0.1
    with pytest.raises(UnstableGraspError, match=r"^two hard fingers .* planar_normal, or torsional"):
        changed(toy.model, contacts=select(toy.contacts, [0, 1])).linearize(toy.state)


def test_one_soft_contact_cannot_hold_but_the_answer_is_finite(toy):
    soft = select(toy.contacts, [0]).replace(torsional_friction=torch.full((1,), 0.005, dtype=F64))
    with pytest.raises(UnstableGraspError) as caught:  # the object topples
        changed(toy.model, contacts=soft).linearize(toy.state)
    assert caught.value.direction[-3:].norm() > 0.1
    lin = changed(toy.model, contacts=soft, options={"on_unstable": "flag"}).linearize(toy.state)
    assert lin.status is ModelStatus.UNSTABLE
    assert lin.forces.status == (ForceStatus.NOT_GRASPABLE,)
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_coincident_contacts_on_one_link_change_nothing(toy):
    twice = select(toy.contacts, [0, 1, 2, 2])
    J = toy.model.linearize(toy.state).manipulation_jacobian
    lin = changed(toy.model, contacts=twice).linearize(toy.state)
    assert torch.isfinite(lin.manipulation_jacobian).all()
    assert relative_error(lin.manipulation_jacobian, J, 9) < 1e-6
    assert float(lin.forces.normal[2:].sum()) == pytest.approx(
        float(toy.model.linearize(toy.state).forces.normal[2])
    )


def test_an_object_that_cannot_be_held_says_so_and_the_step_leaves_out_the_forces(toy):
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    lin = changed(toy.model, contacts=slippery).linearize(toy.state)
    assert lin.status is ModelStatus.NO_FORCES
    assert lin.forces.status == (ForceStatus.NOT_GRASPABLE,)
    assert float(lin.forces.violation) > 0.05
    assert not lin.forces.solved
    for name in ("mu", "lam", "normal", "margin", "residual"):
        assert torch.isfinite(getattr(lin.forces, name)).all()
    assert torch.isfinite(lin.manipulation_jacobian).all()


def test_forces_of_the_previous_step_are_reused_for_the_same_contacts_only(toy):
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
def test_forces_of_a_previous_step_stand_in_for_every_state_of_a_batch(toy, batched):
    states = batch_of(toy.state, dataclasses.replace(toy.state, q=toy.state.q + 0.004))
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    before = (states, stacked(*[toy.contacts] * 2)) if batched else (toy.state, toy.contacts)
    previous = toy.model.linearize(*before)
    again = toy.model.linearize(states, stacked(slippery, slippery), previous=previous)
    assert again.status is ModelStatus.REUSED_FORCES
    assert torch.equal(again.forces.mu, previous.forces.mu.expand(2, -1))
    assert torch.equal(again.forces.mu[0], again.forces.mu[1]) is not batched


def test_a_finger_through_the_object(toy):
    deep = toy.contacts.replace(gap=torch.tensor([0.0, -0.02, 0.0], dtype=F64))
    with pytest.raises(PenetrationError, match="f1_l2") as caught:
        changed(toy.model, contacts=deep).linearize(toy.state)
    assert caught.value.depth == pytest.approx(0.02)


def test_zero_springs_are_singular_unless_there_is_a_floor(toy):
    with pytest.raises((SingularGraspError, UnstableGraspError)) as caught:
        changed(toy.model, spring_stiffness=np.zeros(9)).linearize(toy.state)
    assert torch.isfinite(caught.value.direction).all()
    # a free finger without springs: a floor does not change what the object does
    model, solver, at = gripped("box")
    free = [k for k, name in enumerate(model.hand.joint_names) if name.startswith(("ring", "little"))]
    stiffness = model.hand.spring_stiffness.copy()
    stiffness[free] = 0.0
    forces = solver.forces(at)

    def linear(springs):
        return changed(model, spring_stiffness=springs).linearize(at.state, at.contacts, forces=forces)

    with pytest.raises(SingularGraspError, match=r"joints meets neither stiffness nor .* a spring") as caught:
        linear(stiffness)
    assert float(caught.value.direction[free].norm()) == pytest.approx(1.0)  # of ring and little
    ours = [linear(stiffness + floor * (stiffness == 0)).object_jacobian for floor in (1e-4, 2e-4)]
    assert relative_error(ours[0], ours[1], 0) < 5e-3


def test_more_tendons_than_mobility():
    # planar two-finger grasp: 4 + 3 - 4 = 3 freedoms; four rigid tendons contradict each other
    arms = np.diag([0.009, 0.008, 0.009, 0.008])
    rigid, soft = (planar_two_finger(J_a=arms, stiffness=stiffness) for stiffness in (np.inf, 1e4))
    with pytest.raises(SingularGraspError, match="actuator"):
        rigid.model.linearize(rigid.state)
    assert torch.isfinite(soft.model.linearize(soft.state).manipulation_jacobian).all()


def test_a_grip_too_strong_buckles():
    toy = three_finger(grip=4.0)
    forces = toy.forces()
    with pytest.raises(UnstableGraspError, match="buckles") as caught:
        toy.model.linearize(toy.state, forces=forces)
    assert caught.value.stiffness < 0
    assert caught.value.direction.shape == (15,)
    A = constraint_matrix(toy.model.contact_kinematics(toy.state, toy.contacts))
    assert (A @ caught.value.direction).abs().max() < 1e-12  # the contacts allow it: state coordinates
    lin = changed(toy.model, options={"on_unstable": "flag"}).linearize(toy.state, forces=forces)
    assert lin.status is ModelStatus.UNSTABLE
    assert float(lin.stability) < 0


def test_the_whole_problem_turned_in_space_gives_the_turned_answer(toy):
    # turning hand, object, contacts and gravity must turn do and dphi and change nothing else
    Q = exp(torch.tensor([0.3, -0.7, 1.1], dtype=F64))
    T = torch.eye(4, dtype=F64)
    T[:3, :3] = Q
    fingers = [
        [((T @ o if j == 0 else o).numpy(), z.numpy()) for j, (o, z) in enumerate(finger)]
        for finger in toy.model.kinematics.fingers
    ]
    c = toy.contacts
    contacts = c.replace(
        point=c.point @ Q.mT,
        normal=c.normal @ Q.mT,
        finger_curvature=Q @ c.finger_curvature @ Q.mT,
        object_curvature=Q @ c.object_curvature @ Q.mT,
    )
    gravity = tuple((Q @ torch.tensor([0.0, 0.0, -9.81], dtype=F64)).tolist())
    model = KinematicModel(
        dataclasses.replace(toy.model.hand, gravity=gravity),
        toy.model.obj,
        kinematics=ChainKinematics(fingers),
        detector=lambda *_: contacts,
    )
    state = GraspState(toy.state.q, Q @ toy.state.position, Q @ toy.state.rotation)
    J = toy.model.linearize(toy.state).manipulation_jacobian
    turned = torch.block_diag(torch.eye(9, dtype=F64), Q, Q) @ J
    assert relative_error(model.linearize(state).manipulation_jacobian, turned, 9) < 1e-6


def test_a_singular_projected_stiffness_does_no_harm_to_the_two_stage_form():
    # two freedoms, one actuator on the first: K = diag(0, 1) is singular, N^T D N = 1 is not
    D = torch.diag(torch.tensor([0.0, 1.0], dtype=F64))
    step = two_stage(D, torch.eye(1, 2, dtype=F64), torch.eye(1, dtype=F64))
    assert torch.allclose(step.motion, torch.tensor([[1.0], [0.0]], dtype=F64))


def test_fully_determined_springless_hand_is_purely_kinematic():
    E = torch.tensor([[1.0, 2.0], [0.5, -1.0]], dtype=F64)
    step = two_stage(torch.zeros(2, 2, dtype=F64), E, torch.eye(2, dtype=F64))
    assert torch.allclose(step.motion, torch.linalg.inv(E))
    assert torch.isinf(step.stability)
