from __future__ import annotations

import itertools
import math

import numpy as np

from .._extras import require
from ..contact import grasp_matrix
from ..contact.contact_set import CHARACTERISTIC_LENGTH
from ..model import KinematicModel, Linearization

_SIDES = 12  # of the pyramid inside a friction cone
_NORMAL = 0.3  # [N] by which a normal force may be off


def friction_share(model: KinematicModel, lin: Linearization) -> float:
    """``min_f max_i (|f_t,i|/mu_i + |m_i|/gamma_i) / f_n,i`` over all contact forces that balance the weight.

    The normal forces are those of ``lin``, give or take 0.3 N; how the fingers push each other along the
    object is free, and m are spin moments of soft fingers. In a plane of motion only what lies in it is
    balanced. Above 1 no force within the cones holds the object, whatever the fingers do; infinite: none at
    all. A linear program, with a pyramid of 12 sides (soft fingers: 24) inside each cone.

    A contact that creeps at its friction limit has a margin of 0 for as long as it creeps. This figure shows
    whether the others still hold what it lets go of.

    Args:
        lin: of one state, with its forces.
    """
    optimize = require("scipy.optimize")
    contacts, n, L = lin.contacts, lin.contacts.n_c, CHARACTERISTIC_LENGTH
    kin = model.contact_kinematics(lin.state, contacts)
    parts = [divmod(row, 6) for row in kin.rows]
    # columns: the components of mu, then the share
    G, load = grasp_matrix(kin).numpy().copy(), model.potential(lin.state)[0][-6:].numpy().copy()
    G[3:] /= L
    load[3:] /= L
    free = model.reduction.pose_basis.numpy()  # of the object: what the plane of motion holds is left out
    G, load = free.T @ G, free.T @ load
    normal = lin.forces.normal.clamp_min(0.0).tolist()
    cost, bounds, inside = np.zeros(len(parts) + 1), [], []
    cost[-1] = 1.0
    for contact, part in parts:
        low, high = max(normal[contact] - _NORMAL, 0.0), normal[contact] + _NORMAL
        bounds.append((low, high) if part == 0 else (None, None))
    for i in range(n):
        tangents = [column for column, at in enumerate(parts) if at in ((i, 1), (i, 2))]
        spin = [column for column, at in enumerate(parts) if at == (i, 3)]
        friction, torsional = float(contacts.friction[i]), float(contacts.torsional_friction[i])
        angles = np.arange(_SIDES) * (2 * math.pi / _SIDES)
        for angle, sign in itertools.product(angles, (1, -1)[: 1 + len(spin)]):
            side = np.zeros(len(parts) + 1)
            side[tangents] = [math.cos(angle), math.sin(angle)][: len(tangents)]
            side[spin] = sign * friction / torsional if spin else 0.0
            side[-1] = -friction * normal[i] * math.cos(math.pi / _SIDES)
            inside.append(side)
    balance, bounds = np.column_stack([G, np.zeros(len(G))]), [*bounds, (0, None)]
    found = optimize.linprog(cost, np.array(inside), np.zeros(len(inside)), balance, load, bounds=bounds)
    return float(found.x[-1]) if found.status == 0 else math.inf
