"""The linearization of a grasp in one mode of its contacts."""

from __future__ import annotations

import numpy as np
import torch

from ...contact.forces.balance import ForceStatus
from ...contact.forces.friction import friction_cones, margins
from ...typing import Array
from ..force_balance import pack_forces
from ..linearization import Linearization
from ..sensitivity import sensitivities
from ..validity import find_doubts
from .placed_grasp import ContactLoads, GraspModel, L, PlacedGrasp


def mode_linearization(
    model: GraspModel,
    grasp: PlacedGrasp,
    loads: ContactLoads,
    bears: list[int],
    motion: Array,
    normal: Array,
    tangential: Array,
    actuator: Array,
    stop: Array,
) -> Linearization:
    """``J_m`` and the force sensitivities of the contacts that bear.

    Args:
        model: of hand and object.
        grasp: the state.
        loads: forces there.
        bears: indices of the contacts of ``grasp`` that are kept.
        motion: ds/da, ``(n_s, n_a)``.
        normal, tangential: change of the forces of all contacts in their frames, ``(n_c, n_a)``,
            ``(n_c, d, n_a)`` [scaled].
        actuator: dlam/da, ``(n_a, n_a)``.
        stop: torque of the joints' stops after the motion [N m].
    """
    contacts = grasp.contacts.select(bears)
    kin = model.contact_kinematics(grasp.state, contacts)
    lam, t = grasp.components(loads)
    mu, dmu = [], []
    for i, one in zip(bears, kin.models, strict=True):
        scale = np.array([1.0, 1.0, grasp.spin_scale[i] * L])[: len(one.rows) - 1] / L
        mu += [lam[i] / L, *(t[i, : len(scale)] * scale)]
        dmu += [normal[i] / L, *(tangential[i, : len(scale)] * scale[:, None])]
    mu_t, dmu_t, J = torch.tensor(mu), torch.from_numpy(np.stack(dmu)), torch.from_numpy(motion)
    cones = friction_cones(kin.models, contacts.friction.tolist(), contacts.torsional_friction.tolist())
    margin, relative = (torch.from_numpy(x) for x in margins(cones, mu_t.numpy()))
    forces = pack_forces(
        kin,
        mu=mu_t,
        lam=-torch.from_numpy(loads.pull),
        residual=torch.zeros(model.hand.n_q, dtype=torch.float64),
        stop_torque=torch.from_numpy(loads.stop),
        margin=margin,
        relative_margin=relative,
        violation=torch.zeros((), dtype=torch.float64),
        status=(ForceStatus.SOLVED,),
        loop=torch.from_numpy(loads.loop),
    )
    stability = torch.tensor(torch.inf, dtype=torch.float64)
    return Linearization(
        state=grasp.state,
        contacts=contacts,
        forces=forces,
        **sensitivities(kin, forces, J, dmu_t),
        actuator_force_sensitivity=torch.from_numpy(actuator),
        held_joints=torch.from_numpy(stop != 0),
        stability=stability,
        options=model.options,
        doubts=find_doubts(model.options, model.hand.joint_names, contacts, forces, stability, reused=False),
    )
