"""Grasp matrices, ranks and quality against figures known from the theory."""

import pytest
import torch
from contact_samples import F64, RADIUS, THREE, ball_contacts, held

from torch_ekm.contact.contacts import (
    ContactModel,
    analyse,
    constraint_matrix,
    contact_frames,
    full_grasp_matrix,
    full_hand_jacobian,
    grasp_matrix,
    hand_jacobian,
    rolling_mobility,
    selected_rows,
)
from torch_ekm.kinematics.se3 import exp


def test_contact_frames_are_rotations_with_the_inward_normal_first():
    n = torch.randn(500, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    n[0], n[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    n = n / n.norm(dim=-1, keepdim=True)
    C = contact_frames(n)
    assert (C.mT @ C - torch.eye(3, dtype=F64)).abs().max() < 1e-14
    assert (torch.linalg.det(C) - 1).abs().max() < 1e-13
    assert torch.equal(C[..., 0], -n)


def test_grasp_matrix_maps_forces_to_the_wrench_about_the_object_point():
    kin = held(THREE, gamma=0.003)
    G = grasp_matrix(kin)
    mu = torch.randn(G.shape[1], dtype=F64, generator=torch.Generator().manual_seed(2))
    wrench = torch.zeros(6, dtype=F64)
    for i in range(3):
        C, f = kin.frame[i], mu[4 * i : 4 * i + 3]
        wrench[:3] += C @ f
        wrench[3:] += torch.linalg.cross(kin.lever[i], C @ f) + C[:, 0] * mu[4 * i + 3]
    assert torch.allclose(G @ mu, wrench, atol=1e-15)


def test_constraint_rows_are_the_velocities_of_the_contact_points():
    # move the joints and the object by a small step and difference the positions of the material points
    kin = held(THREE, joints_per_finger=1)
    A, n_q, h = constraint_matrix(kin), 3, 1e-6
    generator = torch.Generator().manual_seed(3)
    dq, dp = torch.randn(n_q, dtype=F64, generator=generator), torch.randn(6, dtype=F64, generator=generator)
    x = kin.contacts.point
    axis = kin.axis
    for i in range(3):
        v_joint = kin.point_jacobian[i, :, i] * dq[i]
        # the finger turns about the axis through x - r where z x r = v; rebuild r from the Jacobian itself
        r = torch.linalg.cross(kin.point_jacobian[i, :, i], axis[i])
        finger = [exp(s * h * dq[i] * axis[i]) @ r - r for s in (1.0, -1.0)]
        object_ = [s * h * dp[:3] + exp(s * h * dp[3:]) @ x[i] - x[i] for s in (1.0, -1.0)]
        relative = ((finger[0] - object_[0]) - (finger[1] - object_[1])) / (2 * h)
        assert torch.allclose((finger[0] - finger[1]) / (2 * h), v_joint, atol=1e-9)
        ds = torch.cat([dq, dp])
        assert torch.allclose(A[3 * i : 3 * i + 3] @ ds, kin.frame[i].mT @ relative, atol=1e-9)


def test_selection_of_contact_models():
    models = [ContactModel.FRICTIONLESS, ContactModel.POINT_WITH_FRICTION, ContactModel.SOFT_FINGER]
    kin = held(THREE, models=models)
    H = torch.eye(18, dtype=F64)[selected_rows(models)]
    assert H.shape == (8, 18)
    assert torch.equal(hand_jacobian(kin), H @ full_hand_jacobian(kin))
    assert torch.equal(grasp_matrix(kin), full_grasp_matrix(kin) @ H.mT)


def test_rolling_mobility_of_ball_on_ball_cylinder_and_pin():
    n = torch.tensor([[0.0, 0.6, 0.8]], dtype=F64)
    contacts = ball_contacts(n.tolist())
    C = contact_frames(contacts.normal)
    eye = torch.eye(3, dtype=F64)
    tangent = eye - torch.outer(n[0], n[0])
    rho = 0.006
    expected = rho * RADIUS / (rho + RADIUS) * tangent  # sphere on sphere
    assert torch.allclose(rolling_mobility(contacts)[0], expected, atol=1e-15)
    # a cylinder on a plane rolls about its axis only
    t = C[0, :, 1]
    K = (tangent - torch.outer(t, t)) / rho
    cylinder = contacts.replace(finger_curvature=K[None], object_curvature=torch.zeros(1, 3, 3, dtype=F64))
    expected = rho * (tangent - torch.outer(t, t))
    assert torch.allclose(rolling_mobility(cylinder)[0], expected, atol=1e-15)
    flat = cylinder.replace(finger_curvature=torch.zeros(1, 3, 3, dtype=F64))
    assert rolling_mobility(flat).abs().max() == 0
    assert rolling_mobility(contacts.replace(pinned=(True,))).abs().max() == 0


def test_a_planar_pinch_is_analysed_in_its_plane():
    """Two points with friction hold an object in a plane: four forces, one of them the squeeze."""
    kin = held([[1.0, 0, 0], [-1.0, 0, 0]], plane=[0.0, 0.0, 1.0])
    found = analyse(kin, torch.eye(2, 6, dtype=F64))
    assert (found.indeterminate, found.internal_forces) == (False, 1)
    assert found.mobility == 6 + 3 - 4


@pytest.mark.parametrize(("gamma", "rank"), [(0.0, 5), (0.004, 6)])
def test_two_points_cannot_turn_the_object_about_their_line_but_soft_fingers_can(gamma, rank):
    kin = held([[1.0, 0, 0], [-1.0, 0, 0]], gamma=gamma)
    analysis = analyse(kin, torch.eye(2, 6, dtype=F64))
    assert analysis.indeterminate is (rank == 5)
    assert analysis.internal_forces == grasp_matrix(kin).shape[1] - rank


def test_ranks_of_a_three_finger_grasp():
    kin = held(THREE)  # 9 joints + 6 object freedoms, 9 contact rows
    analysis = analyse(kin, torch.eye(3, 9, dtype=F64))
    assert analysis.mobility == 6
    assert analysis.internal_forces == 3
    assert analysis.undetermined_forces == 0
    assert not analysis.indeterminate
    # all 9 joints driven: 9 + 9 unknown forces against 15 equations
    assert analyse(kin, torch.eye(9, dtype=F64)).undetermined_forces == 3
