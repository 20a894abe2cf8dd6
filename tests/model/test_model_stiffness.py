"""D in closed form against automatic differentiation of the equilibrium equations."""

from __future__ import annotations

import pytest
import torch
from model_icub import gripped
from model_toys import F64, planar_two_finger, soft_two_finger, three_finger

from torch_ekm.contact.contact_kinematics import constraint_matrix, contact_kinematics
from torch_ekm.kinematics.null_space import null_space
from torch_ekm.kinematics.se3 import exp, hat
from torch_ekm.model.stiffness.geometric import geometric_stiffness, precedence
from torch_ekm.model.stiffness.potential import (
    gravity_gradient,
    gravity_hessian,
    posture_stiffness,
    spring_torque,
)


def equilibrium_function(model, state, surfaces, contacts, force, spin):
    """F(ds), contact points following the surfaces; forces constant in hand axes, spin about the normal."""
    links = [model.link_names.index(name) for name in contacts.link]
    upstream = model.kinematics.upstream[links]

    def F(ds):
        n_q = len(state.q)
        q, o = state.q + ds[:n_q], state.position + ds[n_q : n_q + 3]
        R = exp(ds[n_q + 3 :]) @ state.rotation
        now = surfaces(q, o, R)
        axis, origin = model.kinematics.joint_axes(model.kinematics(q))
        kin = contact_kinematics(now, o, axis, origin, upstream, plane=model.plane)
        moment = -now.normal * spin[:, None]
        joint = (kin.point_jacobian.mT @ force[..., None]).sum(0)[:, 0]
        joint = joint + (kin.spin_jacobian.mT @ moment[..., None]).sum(0)[:, 0]
        wrench = torch.cat([force.sum(0), (torch.linalg.cross(kin.lever, force) + moment).sum(0)])
        V_q = spring_torque(q, model.spring_stiffness, model.spring_rest)
        return torch.cat([V_q + joint, gravity_gradient(model.weight, R @ model.com) - wrench])

    return F


def closed_form(model, state, kin, forces):
    D = geometric_stiffness(kin, forces.force, forces.spin_moment, model.precedes)
    n_q = len(state.q)
    D[:n_q, :n_q] += torch.diag(model.spring_stiffness)
    D[n_q:, n_q:] += gravity_hessian(model.weight, state.rotation @ model.com)
    return D


@pytest.mark.parametrize(
    "make",
    [
        planar_two_finger,
        three_finger,
        lambda: three_finger(pinned=True, grip=0.4),
        soft_two_finger,
        lambda: soft_two_finger(k_o=30.0),
    ],
    ids=["planar", "spatial", "pinned", "soft", "soft on balls"],
)
def test_projected_stiffness_equals_automatic_differentiation(make):
    toy = make()
    model, state = toy.model, toy.state
    forces = toy.forces()
    kin = model.contact_kinematics(state, toy.contacts)
    solver = toy.solver()
    F = equilibrium_function(model, state, solver.surfaces, toy.contacts, forces.force, forces.spin_moment)
    automatic = torch.func.jacfwd(F)(torch.zeros(state.n_s, dtype=F64))
    Z = torch.block_diag(model.reduction.joint_basis, model.reduction.pose_basis)
    R = Z @ null_space(constraint_matrix(kin) @ Z)
    difference = R.mT @ (closed_form(model, state, kin, forces) - automatic) @ R
    assert difference.norm() < 1e-10 * (R.mT @ automatic @ R).norm()


@pytest.mark.parametrize("shape", ["box", "can"])
def test_projected_stiffness_of_the_icub_pinch(shape):
    model, solver, at = gripped(shape)
    forces = solver.forces(at)
    kin = model.contact_kinematics(at.state, at.contacts)
    F = equilibrium_function(model, at.state, solver.surfaces, at.contacts, forces.force, forces.spin_moment)
    automatic = torch.func.jacfwd(F)(torch.zeros(26, dtype=F64))
    R = null_space(constraint_matrix(kin))
    difference = R.mT @ (closed_form(model, at.state, kin, forces) - automatic) @ R
    assert difference.norm() < 1e-10 * (R.mT @ automatic @ R).norm()


def test_holonomic_contacts_give_a_symmetric_stiffness_and_rolling_in_space_does_not():
    def asymmetry(toy):
        kin = toy.model.contact_kinematics(toy.state, toy.contacts)
        Z = torch.block_diag(toy.model.reduction.joint_basis, toy.model.reduction.pose_basis)
        R = Z @ null_space(constraint_matrix(kin) @ Z)
        K = R.mT @ closed_form(toy.model, toy.state, kin, toy.forces()) @ R
        return float((K - K.mT).norm() / K.norm())

    assert asymmetry(planar_two_finger()) < 1e-12
    assert asymmetry(three_finger(pinned=True, grip=0.4)) < 1e-12
    assert asymmetry(three_finger()) > 1e-4
    assert asymmetry(soft_two_finger()) > 1e-4


def test_posture_stiffness_is_the_hessian_of_the_work_of_constant_forces():
    toy = three_finger()
    kin = toy.model.kinematics
    point = torch.tensor([0.002, -0.004, 0.03, 1.0], dtype=F64)
    force = torch.randn(9, 3, dtype=F64, generator=torch.Generator().manual_seed(0))

    def work(q):
        return (force * (kin(q).transforms @ point)[:, :3]).sum()

    q = toy.state.q
    axis, origin = kin.joint_axes(kin(q))
    x = (kin(q).transforms @ point)[:, :3]
    precedes = precedence(kin.upstream)
    velocity = torch.linalg.cross(axis[None] * kin.upstream[..., None].to(F64), x[:, None] - origin[None])
    S = posture_stiffness(force, velocity, axis, precedes)
    assert torch.allclose(S, torch.func.hessian(work)(q), atol=1e-12)


def test_gravity_terms_are_derivatives_of_the_height():
    weight = torch.tensor([0.1, -0.5, -0.8], dtype=F64)
    com = torch.tensor([0.004, -0.003, 0.01], dtype=F64)
    R = exp(torch.tensor([0.4, 0.2, -0.9], dtype=F64))

    def potential(dp):
        return -weight @ (dp[:3] + exp(dp[3:]) @ R @ com)

    zero = torch.zeros(6, dtype=F64)
    assert torch.allclose(gravity_gradient(weight, R @ com), torch.func.grad(potential)(zero), atol=1e-15)

    def gradient(dp):
        return gravity_gradient(weight, exp(dp[3:]) @ R @ com)

    assert torch.allclose(gravity_hessian(weight, R @ com), torch.func.jacfwd(gradient)(zero), atol=1e-15)
    # the symmetric part is the Hessian in exponential coordinates
    hessian = torch.func.hessian(potential)(zero)
    ours = gravity_hessian(weight, R @ com)
    assert torch.allclose(0.5 * (ours + ours.mT), hessian, atol=1e-12)


def test_a_pinned_squeeze_destabilises_and_rolling_stabilises():
    # force -F n at lever rho n: -F rho (I - n n^T) on the rotation; rolling adds +F (K_f + K_o)^-1
    toy = three_finger()
    kin = toy.model.contact_kinematics(toy.state, toy.contacts)
    n, F, rho = toy.contacts.normal, 2.0, 0.02
    force = torch.zeros_like(kin.lever)
    force[0] = -F * n[0]
    object.__setattr__(kin, "lever", rho * n)
    tangent = torch.eye(3, dtype=F64) - torch.outer(n[0], n[0])
    spin = torch.zeros(3, dtype=F64)
    still = toy.model.contact_kinematics(toy.state, toy.contacts, rolling=False)
    object.__setattr__(still, "lever", rho * n)
    pinned = geometric_stiffness(still, force, spin, toy.model.precedes)[-3:, -3:]
    assert torch.allclose(pinned, -F * rho * tangent, atol=1e-14)
    rolled = geometric_stiffness(kin, force, spin, toy.model.precedes)[-3:, -3:]
    assert torch.allclose(rolled - pinned, F * 0.008 * tangent, atol=1e-14)
    assert torch.allclose(hat(n[0]) @ n[0], torch.zeros(3, dtype=F64), atol=1e-15)
