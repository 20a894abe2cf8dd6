"""The actuation map: virtual work, couplings, where a free hand rests, what constraints leave free; play.

What the motors of iCub hands move: robotology/gazebo-yarp-plugins @f837061b, ControlBoardDriverCoupling.cpp.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import write_hand
from mk3 import distal_angle

from torch_ekm._arrays import null_space
from torch_ekm.description import HandDescription, load_hand
from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.kinematics import ActuationMap, Play
from torch_ekm.simulation import PlantParameters
from torch_ekm.simulation.mechanism.servo import Servo

HANDS = ("icub_right", "icub_left", "planar_two_finger")


def rigid(name: str) -> HandDescription:
    """A hand whose drives have no compliance and pull both ways."""
    hand = load_hand(name)
    actuators = (dataclasses.replace(one, stiffness=math.inf, tendon=False) for one in hand.actuators)
    free = np.full(hand.n_q, np.inf)
    return dataclasses.replace(hand, actuators=tuple(actuators), joint_lower=-free, joint_upper=free)


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_joints_invert_actuators_of_rigid_drives(name: str, shape: tuple[int, ...]) -> None:
    """Affine: the least spring energy of all postures with these actuator positions."""
    hand = rigid(name)
    actuation = ActuationMap(hand)
    a = torch.rand(*shape, hand.n_a, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    q = actuation.joints(a)
    assert q.shape == (*shape, hand.n_q)
    torch.testing.assert_close(actuation.actuators(q), a, atol=1e-12, rtol=0)
    slip = torch.from_numpy(hand.coupling) @ (q - torch.from_numpy(hand.spring_rest))[..., None]
    torch.testing.assert_close(slip, torch.zeros_like(slip), atol=1e-12, rtol=0)
    rows = np.vstack([hand.actuation_jacobian, hand.coupling])
    N, K = null_space(rows), np.diag(hand.spring_stiffness)
    P = np.linalg.pinv(rows)[:, : hand.n_a]
    P = P - N @ np.linalg.solve(N.T @ K @ N, N.T @ K @ P) if N.size else P
    excess = (a - actuation.actuators(torch.from_numpy(hand.spring_rest))).numpy()
    torch.testing.assert_close(q, torch.from_numpy(hand.spring_rest + excess @ P.T), atol=1e-12, rtol=0)
    torch.testing.assert_close(
        actuation.free_motion(a)[..., :, :], torch.from_numpy(P).expand(*shape, -1, -1)
    )


@pytest.mark.parametrize("name", HANDS)
def test_free_motion_is_an_equilibrium(name: str) -> None:
    """``K_s (q - q0) = J^T k (a - l)`` along what couplings and stops leave free."""
    hand = load_hand(name)
    actuation = ActuationMap(hand)
    a = torch.from_numpy(0.6 * hand.actuator_lower + 0.4 * hand.actuator_upper).requires_grad_()
    q = actuation.joints(a)
    stretch = (a - actuation.actuators(q)).detach().numpy()
    k = np.array([one.stiffness for one in hand.actuators])
    torque = hand.spring_stiffness * (q.detach().numpy() - hand.spring_rest)
    assert np.abs(torque).max() > 0.01
    q_now = q.detach().numpy()
    stopped = (q_now <= hand.joint_lower + 1e-9) | (q_now >= hand.joint_upper - 1e-9)
    N = null_space(np.vstack([hand.coupling, np.eye(hand.n_q)[stopped]]))
    assert np.abs(N.T @ (torque - (k * stretch) @ hand.actuation_jacobian)).max() < 1e-10
    eye = 1e-6 * torch.eye(hand.n_a, dtype=torch.float64)
    change = (actuation.joints(a + eye) - actuation.joints(a - eye)).detach().T / 2e-6
    torch.testing.assert_close(actuation.free_motion(a), change, atol=1e-8, rtol=0)
    (slope,) = torch.autograd.grad(q.sum(), a)
    torch.testing.assert_close(slope, change.sum(0), atol=1e-8, rtol=0)


def test_errors() -> None:
    actuation = ActuationMap(load_hand("planar_two_finger"))
    with pytest.raises(ShapeError, match="left, right"):
        actuation.joints(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="left_0, left_1"):
        actuation.actuators(torch.zeros(2, dtype=torch.float64))
    assert "joints=4" in repr(actuation)
    single = ActuationMap(load_hand("planar_two_finger"), dtype=torch.float32)
    assert single.joints(torch.zeros(2)).dtype == torch.float32


F64 = torch.float64


@pytest.mark.parametrize(("m", "n", "repeated"), [(3, 7, 0), (3, 7, 2), (5, 5, 0), (0, 4, 0), (4, 0, 0)])
def test_it_is_orthonormal_and_complete(m, n, repeated):
    rows = torch.randn(m, n, dtype=F64, generator=torch.Generator().manual_seed(m))
    N = null_space(torch.cat([rows, rows[:repeated] + rows[1 : repeated + 1]]))
    assert N.shape == (n, max(n - m, 0))
    assert torch.allclose(N.mT @ N, torch.eye(N.shape[1], dtype=F64))
    assert (rows @ N).abs().amax() < 1e-14 if rows.numel() and N.numel() else True


def test_a_row_of_rounding_errors_takes_nothing():
    assert null_space(torch.full((1, 3), 1e-17, dtype=F64)).shape == (3, 3)


def test_the_hand_has_the_public_coupling() -> None:
    """Where the public coupling puts the joints for positions ``a``, the motors are at ``a``."""
    hand = load_hand("icub_right")
    for a in np.random.default_rng(0).uniform(10.0, 50.0, (10, 9)):
        spread = 20 - a[0] / 3
        q = [a[1], a[2], a[3] / 2, a[3] / 2, spread, a[4], a[5] / 2, a[5] / 2]
        q += [0.0, a[6], a[7] / 2, a[7] / 2, *[spread, *[a[8] / 3] * 3] * 2]
        posture = torch.from_numpy(np.radians(q))
        assert np.degrees(ActuationMap(hand).actuators(posture).numpy()) == pytest.approx(a, abs=1e-9)
        np.testing.assert_allclose(hand.coupling @ (posture.numpy() - hand.spring_rest), 0, atol=1e-12)


def test_the_third_generation_closes_as_its_rods_say(tmp_path: Path) -> None:
    """Closed, both joints of a finger are at the limits of the public URDF."""
    hand = load_hand(write_hand("mk3", tmp_path))
    assert (hand.n_q, hand.n_a) == (11, 7)
    actuation, upper = ActuationMap(hand), torch.from_numpy(hand.actuator_upper)
    closed = dict(zip(hand.joint_names, np.degrees(actuation.joints(upper).numpy()), strict=True))
    middle = dict(zip(hand.joint_names, np.degrees(actuation.joints(upper / 2).numpy()), strict=True))
    for finger, sums in (("thumb", (85, 55)), ("index", (95, 105.3)), ("medium", (95, 105.3))):
        near, far = (closed[f"{finger}_{which}"] for which in ("proximal", "distal"))
        assert (near, far) == pytest.approx(sums, abs=0.1)
        near, far = (middle[f"{finger}_{which}"] for which in ("proximal", "distal"))
        assert near + far == pytest.approx(sum(sums) / 2, abs=0.01)
        rod = "thumb" if finger == "thumb" else "index"
        assert far == pytest.approx(np.degrees(distal_angle(rod, np.radians(near))), abs=0.02)


WIDTH = torch.tensor([0.02, 0.05, 0.0], dtype=F64)


def walk(seed, steps=40):
    return 0.03 * torch.randn(steps, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def servo():
    mechanism = Servo(
        np.full(3, -10.0), np.full(3, 10.0), PlantParameters(), described_backlash=WIDTH.numpy()
    )
    mechanism.place(np.zeros(3))
    return mechanism


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_play_of_the_simulated_servo(seed):
    mechanism, play = servo(), Play(WIDTH)
    state = play.at(torch.zeros(3, dtype=F64))
    for delta in walk(seed):
        before = mechanism.output
        output = mechanism.move_to(mechanism.encoder + delta.numpy())
        transmitted, state = play.advance(state, delta)
        np.testing.assert_allclose(transmitted, output - before, atol=1e-14)
        np.testing.assert_allclose(state.position, output - mechanism.encoder, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_an_unknown_start_is_bounded_and_found_out(seed):
    play, truth = Play(WIDTH), 0.5 * WIDTH * torch.tensor([-1.0, 0.7, 0.0], dtype=F64)
    known, unknown = play.at(truth), play.unknown()
    for delta in walk(seed):
        exact, known = play.advance(known, delta)
        before = unknown.high - unknown.low
        guess, unknown = play.advance(unknown, delta)
        assert (unknown.low - 1e-12 <= known.low).all()
        assert (known.low <= unknown.high + 1e-12).all()
        assert ((unknown.high - unknown.low) <= before + 1e-12).all()
        assert ((guess - exact).abs() <= 0.5 * before + 1e-12).all()
    assert (unknown.high - unknown.low).max() < 1e-12


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_batches(batch):
    play = Play(WIDTH)
    delta = torch.full((*batch, 3), 0.04, dtype=F64)
    transmitted, state = play.advance(play.unknown(), delta)
    assert transmitted.shape == state.low.shape == (*batch, 3)
    torch.testing.assert_close(transmitted, torch.tensor([0.03, 0.02, 0.04], dtype=F64).expand(*batch, 3))


def test_the_derivative_by_the_width_survives_a_walk():
    steps = walk(3)

    def final(width):
        play = Play(width)
        state, total = play.unknown(), torch.zeros(3, dtype=F64)
        for k, delta in enumerate(steps):
            transmitted, state = play.advance(state, delta)
            total = total + (k + 1) * transmitted
        return total

    width = WIDTH + 0.001
    assert torch.autograd.gradcheck(final, (width.requires_grad_(True),), eps=1e-7, atol=1e-6)


def test_it_comes_from_the_description_and_refuses_nonsense():
    hand = load_hand("planar_two_finger")
    assert (Play.of(hand).width == 0).all()
    actuators = tuple(dataclasses.replace(actuator, backlash=0.02) for actuator in hand.actuators)
    play = Play.of(dataclasses.replace(hand, actuators=actuators))
    torch.testing.assert_close(play.width, torch.full((2,), 0.02, dtype=F64))
    with pytest.raises(ShapeError):
        play.advance(play.unknown(), torch.zeros(3, dtype=F64))
    for width in (-0.1, float("nan")):
        with pytest.raises(ParameterError):
            Play(torch.tensor([width]))
