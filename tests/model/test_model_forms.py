"""The three forms of the step agree, and nothing depends on bases, frames or the order of contacts."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from model_toys import F64, planar_two_finger, relative_error, select, soft_two_finger, three_finger
from step_oracles import kkt_form, null_space_form

from torch_ekm.contact.contact_kinematics import constraint_matrix
from torch_ekm.exceptions import SingularGraspError, UnstableGraspError
from torch_ekm.kinematics.null_space import null_space
from torch_ekm.model.manipulation import two_stage
from torch_ekm.model.stiffness.geometric import geometric_stiffness
from torch_ekm.model.stiffness.potential import gravity_hessian

GRASPS = {
    "planar": planar_two_finger,
    "pinned": lambda: three_finger(pinned=True, grip=0.4),
    "rolling": three_finger,
    "soft": soft_two_finger,
}


def matrices(toy):
    """D, A, B in scaled coordinates (translations in units of 30 mm)."""
    model, state = toy.model, toy.state
    kin = model.contact_kinematics(state, toy.contacts)
    forces = toy.forces()
    D = geometric_stiffness(kin, forces.force, forces.spin_moment, model.precedes)
    n_q = len(state.q)
    D[:n_q, :n_q] += torch.diag(model.spring_stiffness)
    D[n_q:, n_q:] += gravity_hessian(model.weight, model.com)
    S = model.reduction.scaled_basis
    A = constraint_matrix(kin) @ S / 0.03
    B = model.reduction.actuation @ S[:n_q]
    return S.mT @ D @ S, A, B, S


@pytest.mark.parametrize("name", GRASPS)
def test_two_stage_kkt_and_null_space_forms_agree(name):
    D, A, B, _ = matrices(GRASPS[name]())
    E, R = (
        torch.cat([A, B]),
        torch.cat([torch.zeros(len(A), len(B), dtype=F64), torch.eye(len(B), dtype=F64)]),
    )
    step = two_stage(D, E, R)
    J_k, dnu = kkt_form(D, E, R)
    J_n = null_space_form(D, A, B)
    size = step.motion.norm()
    assert (step.motion - J_k).norm() < 1e-10 * size
    assert (step.motion - J_n).norm() < 1e-10 * size
    assert (step.reaction - dnu).norm() < 1e-10 * dnu.norm()
    assert (E @ step.motion - R).abs().max() < 1e-12
    assert (D @ step.motion + E.mT @ step.reaction).abs().max() < 1e-11


@pytest.mark.parametrize("name", GRASPS)
def test_gauges(name):
    D, A, B, _ = matrices(GRASPS[name]())
    E, R = (
        torch.cat([A, B]),
        torch.cat([torch.zeros(len(A), len(B), dtype=F64), torch.eye(len(B), dtype=F64)]),
    )
    J = two_stage(D, E, R).motion
    generator = torch.Generator().manual_seed(0)
    Y = torch.randn(len(A), len(A), dtype=F64, generator=generator)  # other frames, other row combinations
    M = torch.randn(len(A), D.shape[0], dtype=F64, generator=generator)  # other meaning of constant mu
    redundant = torch.cat([E, A[:2] + A[1:3]])
    R_more = torch.cat([R, torch.zeros(2, len(B), dtype=F64)])
    for other in (
        two_stage(D, torch.cat([Y @ A, B]), R).motion,
        two_stage(D + A.mT @ M, E, R, on_unstable="flag").motion,
        two_stage(D, redundant, R_more).motion,
    ):
        assert (other - J).norm() < 1e-9 * J.norm()


def test_order_of_contacts_and_frames_do_not_matter():
    toy = three_finger()
    J = toy.model.linearize(toy.state).manipulation_jacobian
    shuffled = select(toy.contacts, [2, 0, 1])
    J_2 = toy.model.linearize(toy.state, shuffled).manipulation_jacobian
    # the forces come from a solver with a tolerance of its own: hence 1e-7 here, 1e-9 with equal forces
    assert relative_error(J_2, J, 9) < 1e-7
    forces = toy.forces()
    import dataclasses

    order = [2, 0, 1]
    forces_2 = dataclasses.replace(
        forces, force=forces.force[order], spin_moment=forces.spin_moment[order], normal=forces.normal[order]
    )
    J_1 = toy.model.linearize(toy.state, forces=forces).manipulation_jacobian
    J_2 = toy.model.linearize(toy.state, shuffled, forces=forces_2).manipulation_jacobian
    assert relative_error(J_2, J_1, 9) < 1e-9


def test_the_whole_problem_turned_in_space_gives_the_turned_answer():
    # turning hand, object, contacts and gravity must turn do and dphi and change nothing else
    from model_toys import ChainKinematics

    from torch_ekm.kinematics import GraspState
    from torch_ekm.kinematics.se3 import exp
    from torch_ekm.model import KinematicModel

    toy = three_finger()
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


def test_compliant_rows_equal_the_compliant_kkt_matrix_and_tend_to_the_rigid_one():
    D, A, B, _ = matrices(three_finger())
    n_a = len(B)
    E, R = torch.cat([A, B]), torch.cat([torch.zeros(len(A), n_a, dtype=F64), torch.eye(n_a, dtype=F64)])
    rigid = two_stage(D, E, R).motion
    errors = []
    for k in (1e1, 1e2, 1e3, 1e4):
        soft = two_stage(D + k * B.mT @ B, A, torch.zeros(len(A), n_a, dtype=F64), k * B.mT).motion
        compliance = torch.cat([torch.zeros(len(A), dtype=F64), torch.full((n_a,), 1 / k, dtype=F64)])
        assert (soft - kkt_form(D, E, R, compliance=compliance)[0]).norm() < 1e-9 * soft.norm()
        errors.append(float((soft - rigid).norm()))
    orders = [math.log10(errors[i] / errors[i + 1]) for i in range(3)]
    assert abs(orders[-1] - 1) < 0.05  # first order in 1/k


def test_null_space_basis_has_the_mobility_of_the_grasp():
    toy = three_finger()
    _, A, _, S = matrices(toy)
    basis = S @ null_space(A)
    assert basis.shape == (15, 6)
    J = toy.model.linearize(toy.state).manipulation_jacobian
    coefficients = torch.linalg.lstsq(basis, J).solution
    assert (basis @ coefficients - J).abs().max() < 1e-10


# -- the situations in which the printed form fails ---------------------------------------------------


def test_a_singular_projected_stiffness_does_no_harm_to_the_two_stage_form():
    # two freedoms, one actuator on the first: K = diag(0, 1) is singular, N^T D N = 1 is not
    D = torch.diag(torch.tensor([0.0, 1.0], dtype=F64))
    B = torch.tensor([[1.0, 0.0]], dtype=F64)
    step = two_stage(D, B, torch.eye(1, dtype=F64))
    assert torch.allclose(step.motion, torch.tensor([[1.0], [0.0]], dtype=F64))
    with pytest.raises(torch.linalg.LinAlgError):
        null_space_form(D, torch.zeros(0, 2, dtype=F64), B)


def test_fully_determined_springless_hand_is_purely_kinematic():
    E = torch.tensor([[1.0, 2.0], [0.5, -1.0]], dtype=F64)
    step = two_stage(torch.zeros(2, 2, dtype=F64), E, torch.eye(2, dtype=F64))
    assert torch.allclose(step.motion, torch.linalg.inv(E))
    assert torch.isinf(step.stability)


def test_contradicting_actuators_are_named_and_a_compliant_one_resolves_it():
    D = torch.eye(2, dtype=F64)
    E = torch.tensor([[1.0, 1.0], [1.0, 1.0]], dtype=F64)
    with pytest.raises(SingularGraspError, match="actuator") as caught:
        two_stage(D, E, torch.eye(2, dtype=F64))
    assert caught.value.direction.shape == (2,)


def test_an_unstable_direction_is_reported():
    D = torch.diag(torch.tensor([1.0, -0.5, 2.0], dtype=F64))
    with pytest.raises(UnstableGraspError) as caught:
        two_stage(D, torch.tensor([[1.0, 0, 0]], dtype=F64), torch.eye(1, dtype=F64))
    assert caught.value.stiffness == pytest.approx(-0.5)
    assert torch.allclose(caught.value.direction.abs(), torch.tensor([0.0, 1.0, 0.0], dtype=F64))
    flagged = two_stage(
        D, torch.tensor([[1.0, 0, 0]], dtype=F64), torch.eye(1, dtype=F64), on_unstable="flag"
    )
    assert float(flagged.stability) == pytest.approx(-0.5)


def test_a_motion_without_stiffness_is_reported():
    D = torch.diag(torch.tensor([1.0, 0.0, 2.0], dtype=F64))
    with pytest.raises(SingularGraspError, match="neither stiffness") as caught:
        two_stage(D, torch.tensor([[1.0, 0, 0]], dtype=F64), torch.eye(1, dtype=F64))
    assert abs(float(caught.value.direction[1])) == pytest.approx(1.0)


@pytest.mark.parametrize(("free", "says"), [(1, "joints .* a spring"), (5, "object .* leave it free")])
def test_the_message_says_whose_motion_it_is(free, says):
    """Three joints, then the object's twist."""
    stiffness = torch.ones(9, dtype=F64)
    stiffness[free] = 0.0
    first = torch.eye(9, dtype=F64)[:1]
    with pytest.raises(SingularGraspError, match=says):
        two_stage(torch.diag(stiffness), first, torch.eye(1, dtype=F64))


def test_a_free_hand_shares_the_motion_by_its_springs():
    # A empty: J = K^-1 J_a^T (J_a K^-1 J_a^T)^-1
    K = torch.diag(torch.tensor([0.2, 0.1, 0.3], dtype=F64))
    J_a = torch.tensor([[1.0, 1.0, 0.5]], dtype=F64)
    expected = torch.linalg.solve(K, J_a.mT) @ torch.linalg.inv(J_a @ torch.linalg.solve(K, J_a.mT))
    assert torch.allclose(two_stage(K, J_a, torch.eye(1, dtype=F64)).motion, expected)
