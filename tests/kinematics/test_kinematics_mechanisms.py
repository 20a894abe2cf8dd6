"""Where free mechanisms rest: as MuJoCo has it, under tendons on their ways, springs, equalities and stops."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

mujoco = pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from mechanisms import MECHANISMS  # noqa: E402

from torch_ekm.description import HandDescription, load_hand  # noqa: E402
from torch_ekm.kinematics import ActuationMap  # noqa: E402

SHARES = (0.15, 0.5, 0.85)  # of the motors' ranges


def hand_of(name: str, folder: Path) -> HandDescription:
    path = folder / "hand.xml"
    path.write_text(MECHANISMS[name])
    return load_hand(path)


def simulated(name: str, ctrl: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Rest of MuJoCo's own dynamics, from a posture nearby; its soft constraints as hard as they can be."""
    model = mujoco.MjModel.from_xml_string(MECHANISMS[name])
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_IMPLICIT
    model.opt.tolerance, model.opt.iterations = 0.0, 200
    model.dof_damping[:], model.dof_armature[:] = 5e-3, 1e-4
    hard = [2e-4, 1.0], [0.999999, 0.999999, 0.001, 0.5, 2.0]
    model.eq_solref[:], model.eq_solimp[:] = hard
    model.jnt_solref[:], model.jnt_solimp[:] = hard
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = q, ctrl
    for _ in range(40):
        mujoco.mj_step(model, data, 1000)
        if np.abs(data.qvel).max() < 1e-9:
            break
    return data.qpos.copy()


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", MECHANISMS)
def test_rests_where_mujoco_does(name: str, share: float, tmp_path: Path) -> None:
    hand = hand_of(name, tmp_path)
    a = hand.actuator_lower + share * (hand.actuator_upper - hand.actuator_lower)
    q = ActuationMap(hand).joints(torch.from_numpy(a)).numpy()
    sign = np.where(hand.actuator_upper <= 0, -1.0, 1.0)  # tendons that pull where they shorten
    there = simulated(name, sign * a, q + 0.02 * np.sin(np.arange(hand.n_q)))
    np.testing.assert_allclose(q, there, atol=1e-6)
