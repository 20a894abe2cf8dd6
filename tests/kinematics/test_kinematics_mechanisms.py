"""Where free mechanisms rest: as MuJoCo has it, under tendons, springs, equalities and stops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import write_hand
from mechanisms import MECHANISMS
from scipy.interpolate import CubicSpline

from torch_ekm.description import HandDescription, load_hand, write_transmission
from torch_ekm.description.hand import ArmFunction, Lengths
from torch_ekm.kinematics import ActuationMap

mujoco = pytest.importorskip("mujoco")

SHARES = (0.15, 0.85)  # of the motors' ranges


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


@pytest.mark.parametrize("name", MECHANISMS)
def test_derivatives_are_those_of_differences(name: str, tmp_path: Path) -> None:
    """Arms, how they change, and P = dq/da."""
    hand = hand_of(name, tmp_path)
    groups = [(hand.lengths, hand.actuation_jacobian)]
    groups += [(part.lengths, part.lengths.typical) for part in (hand.tendon_springs, hand.loops) if part]
    q, h = np.linspace(0.3, 0.8, hand.n_q), 1e-5
    ends = [q + sign * h * np.eye(hand.n_q) for sign in (1, -1)]
    for lengths, arms in groups:
        ahead, back = (lengths.length(end, arms) for end in ends)
        np.testing.assert_allclose(lengths.jacobian(q, arms), (ahead - back).T / (2 * h), atol=1e-9)
        weight = np.linspace(1.0, 2.0, len(arms))
        ahead, back = (np.einsum("i,kij->kj", weight, lengths.jacobian(end, arms)) for end in ends)
        np.testing.assert_allclose(lengths.curvature(q, weight, arms), (ahead - back) / (2 * h), atol=1e-8)
    actuation = ActuationMap(hand)
    a = torch.from_numpy(0.6 * hand.actuator_lower + 0.4 * hand.actuator_upper)
    step = 1e-5 * torch.eye(hand.n_a, dtype=torch.float64)
    change = (actuation.joints(a + step) - actuation.joints(a - step)).T / 2e-5
    torch.testing.assert_close(actuation.free_motion(a), change, atol=1e-5, rtol=1e-5)


def test_a_table_of_arms_is_a_smooth_curve_with_its_exact_integral() -> None:
    angle, arm = [-0.5, 0.3, 0.9, 1.5], [1.15, 1.05, 0.85, 0.7]
    spline, reference = ArmFunction.table(angle, arm), CubicSpline(angle, arm, bc_type="natural")
    lengths = Lengths(np.array([[0.9]]), ((0, 0, spline),))
    q, arms = np.linspace(-0.5, 1.5, 41)[:, None], np.array([[0.9]])
    np.testing.assert_allclose(lengths.jacobian(q, arms)[:, 0], reference(q), atol=1e-12)
    length = [reference.integrate(0.0, float(x)) for x in q[:, 0]]
    np.testing.assert_allclose(lengths.length(q, arms)[:, 0], length, atol=1e-12)
    beyond = np.array([[1.4], [1.6], [1.8]])  # straight
    first, second, third = lengths.jacobian(beyond, arms)[:, 0, 0]
    assert abs(third - 2 * second + first) < 2e-3
    assert abs(lengths.slope(beyond)[1, 0, 0, 0] - lengths.slope(beyond)[2, 0, 0, 0]) < 1e-12
    twice = lengths.length(q, 2 * arms)  # the given arms count: factors of the typical ones
    np.testing.assert_allclose(twice, 2 * lengths.length(q, arms), atol=1e-12)


def test_a_hand_is_written_with_its_functions_and_in_its_own_units(tmp_path: Path) -> None:
    for kind in ("not_round", "metres", "tendon_springs", "four_bar"):
        hand = load_hand(write_hand(kind, tmp_path)).counted()
        again = load_hand(
            write_transmission(hand, tmp_path / f"{kind}_2.transmission.toml").with_name(f"{kind}_2.urdf")
        ).counted()
        q = np.linspace(0.2, 0.9, hand.n_q)
        np.testing.assert_allclose(again.unloaded(q), hand.unloaded(q), atol=1e-12)
        assert [one.unit for one in again.actuators] == [one.unit for one in hand.actuators]
        for mine, its in zip(hand.actuators, again.actuators, strict=True):
            assert its.stiffness == pytest.approx(mine.stiffness)
            assert its.upper == pytest.approx(mine.upper)
        if hand.tendon_springs is not None and again.tendon_springs is not None:
            np.testing.assert_allclose(again.tendon_springs.torque(q), hand.tendon_springs.torque(q))


def test_metres_of_tendon_count_as_the_angle_of_the_spool(tmp_path: Path) -> None:
    metres, angles = (load_hand(write_hand(kind, tmp_path)).counted() for kind in ("metres", "round"))
    assert {one.unit for one in metres.actuators} == {0.01}
    np.testing.assert_allclose(metres.actuation_jacobian, angles.actuation_jacobian, rtol=1e-12)
    for mine, its in zip(metres.actuators, angles.actuators, strict=True):
        assert mine.stiffness == pytest.approx(its.stiffness)
        assert mine.upper == pytest.approx(its.upper)
