"""Nothing depends on axes; what the step says where nothing, or too little, resists a motion."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from model_toys import F64, ChainKinematics, relative_error

from torch_ekm.exceptions import SingularGraspError, UnstableGraspError
from torch_ekm.kinematics import GraspState
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.model.manipulation import two_stage


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


def test_an_unstable_direction_is_reported():
    D = torch.diag(torch.tensor([1.0, -0.5, 2.0], dtype=F64))
    driven = D, torch.eye(1, 3, dtype=F64), torch.eye(1, dtype=F64)
    with pytest.raises(UnstableGraspError) as caught:
        two_stage(*driven)
    assert caught.value.stiffness == pytest.approx(-0.5)
    assert torch.allclose(caught.value.direction.abs(), torch.tensor([0.0, 1.0, 0.0], dtype=F64))
    assert float(two_stage(*driven, on_unstable="flag").stability) == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("free", "says"), [(1, "joints meets neither stiffness nor .* a spring"), (5, "object .* leave it free")]
)
def test_the_message_says_whose_motion_nothing_resists(free, says):
    """Three joints, then the object's twist."""
    stiffness = torch.ones(9, dtype=F64)
    stiffness[free] = 0.0
    with pytest.raises(SingularGraspError, match=says) as caught:
        two_stage(torch.diag(stiffness), torch.eye(1, 9, dtype=F64), torch.eye(1, dtype=F64))
    assert abs(float(caught.value.direction[free])) == pytest.approx(1.0)
