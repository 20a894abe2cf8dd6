"""The exact solver against answers that it does not share a line of code with."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from model_toys import F64, planar_two_finger

from torch_ekm.kinematics.se3 import exp


def test_pinned_equilibria_minimise_the_energy():
    # independent: SLSQP on the potential, contact points glued together, no Jacobian of ours
    scipy_optimize = pytest.importorskip("scipy.optimize")
    toy = planar_two_finger(pinned=True)
    solver, start = toy.solver(), toy.equilibrium()
    a = start.a + torch.tensor([0.4e-3, -0.2e-3], dtype=F64) / toy.unit
    found = solver.move(start, a)
    model = toy.model
    kin, links = model.kinematics, [model.link_names.index(name) for name in toy.contacts.link]
    poses = kin(toy.state.q).transforms[links]
    on_finger = (poses[:, :3, :3].mT @ (toy.contacts.point - poses[:, :3, 3])[..., None])[..., 0]
    on_object = (toy.contacts.point - toy.state.position) @ toy.state.rotation

    def unpack(x):
        x = torch.tensor(x, dtype=F64)
        o = toy.state.position + torch.cat([x[4:6], x.new_zeros(1)]) * 0.03
        return x[:4], o, exp(torch.stack([x.new_zeros(()), x.new_zeros(()), x[6]]))

    def energy(x):
        q, o, R = unpack(x)
        spring = 0.5 * (model.spring_stiffness * (q - model.spring_rest) ** 2).sum()
        return float(spring - model.weight @ (o + R @ model.com))

    def constraints(x):
        q, o, R = unpack(x)
        T = kin(q).transforms[links]
        finger = T[:, :3, 3] + (T[:, :3, :3] @ on_finger[..., None])[..., 0]
        closing = (finger - o - on_object @ R.mT)[:, :2].flatten() / 0.03
        tendons = model.reduction.actuation @ q - a
        return torch.cat([closing, tendons]).numpy()

    x0 = np.concatenate([toy.state.q.numpy(), np.zeros(3)])
    best = scipy_optimize.minimize(
        energy, x0, method="SLSQP", constraints={"type": "eq", "fun": constraints}, options={"ftol": 1e-15}
    )
    q, o, R = unpack(best.x)
    assert (found.state.q - q).abs().max() < 1e-5
    assert (found.state.position - o).abs().max() < 1e-6
    assert (found.state.rotation - R).abs().max() < 1e-5
    assert (found.state.q - toy.state.q).abs().max() > 1e-3  # it did move
