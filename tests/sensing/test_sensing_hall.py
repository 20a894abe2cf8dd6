"""Hall channels and their calibration."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.exceptions import (
    CalibrationError,
    JointMismatchError,
    NonFiniteError,
    ParameterError,
    ShapeError,
)
from torch_ekm.sensing import HallCalibration, JointEstimator, joint_estimator
from torch_ekm.simulation import HallSensors

DEG = torch.pi / 180
REVERSED = (2, 7, 11)  # channels


@pytest.fixture(scope="module")
def hand():
    return load_hand("icub_right")


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def random_posture(hand, n, generator):
    """Joint angles that obey the hand's couplings: ring = little, no abduction of the middle finger."""
    lower, upper = (torch.from_numpy(x.copy()) for x in (hand.joint_lower, hand.joint_upper))
    q = lower + (upper - lower) * torch.rand(n, hand.n_q, generator=generator, dtype=torch.float64)
    place = {name: k for k, name in enumerate(hand.joint_names)}
    for k in range(4):
        q[:, place[f"little_{k}"]] = q[:, place[f"ring_{k}"]]
    q[:, place["index_0"]] = q[:, place["ring_0"]]
    return q


def sensed(hand, sensors, q):
    return q[..., [hand.joint_names.index(joint) for joint in sensors.joints]]


def some_reversed(hand):
    """The hand with the channels of ``REVERSED`` mounted the other way round."""
    mounted = tuple(
        dataclasses.replace(sensor, open=sensor.closed, closed=sensor.open)
        if sorted(s.channel for s in hand.hall_sensors).index(sensor.channel) in REVERSED
        else sensor
        for sensor in hand.hall_sensors
    )
    return dataclasses.replace(hand, hall_sensors=mounted)


def calibrated(sensors, seed=9, n=181):
    sweep = sensors.sweep(n, torch.Generator().manual_seed(seed))
    return HallCalibration.fit(*sweep, sensors.joints)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_readings_are_bytes(hand, generator, batch):
    sensors = HallSensors(hand, seed=1)
    q = random_posture(hand, 6, generator)[: max(1, torch.Size(batch).numel())].reshape(*batch, hand.n_q)
    n = sensors.read(q, generator)
    assert n.shape == (*batch, 15)
    assert bool((n == n.round()).all())
    assert bool(((n >= 0) & (n <= 255)).all())
    estimate = calibrated(sensors).estimate(n)
    assert estimate.q.shape == estimate.std.shape == estimate.valid.shape == (*batch, 15)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_angles_to_one_degree_where_readings_tell(hand, generator, seed):
    """1 deg rms from 8-bit readings over the unsaturated range."""
    sensors = HallSensors(some_reversed(hand), seed)
    calibration = calibrated(sensors)
    q = random_posture(hand, 2000, generator)
    estimate = calibration.estimate(sensors.read(q, generator))
    error = torch.where(estimate.valid, estimate.q - sensed(hand, sensors, q), torch.nan)
    rms = error.square().nanmean(0).sqrt() / DEG
    assert float(rms.max()) < 0.6  # measured 0.32 to 0.38
    assert float(error.square().nanmean().sqrt()) / DEG < 0.4
    chi2 = (error / estimate.std).square().nanmean()
    assert 0.8 < float(chi2) < 1.3
    within = ((error / estimate.std).abs() < 2)[estimate.valid].double().mean()
    assert float(within) > 0.93


def test_the_fit_is_the_least_squares_cubic():
    """A channel that is a cubic is recovered to the last digits, with no misfit."""
    n = torch.linspace(1, 254, 200, dtype=torch.float64)
    q = 1.5 - 1.1 * (n / 255) - 0.2 * (n / 255) ** 2 - 0.1 * (n / 255) ** 3
    calibration = HallCalibration.fit(n[:, None], q[:, None], ["knuckle"])
    (channel,) = calibration.channels
    assert channel.coefficients == pytest.approx((1.5, -1.1, -0.2, -0.1), abs=1e-9)
    assert channel.misfit < 1e-9
    assert channel.noise >= 12**-0.5  # no 8-bit reading is better than its rounding


@pytest.mark.parametrize("rising", [False, True])
def test_pinned_readings_leave_the_right_end_open(rising):
    """Saturated at either end of the scale: the estimate lies past the last angle that can be told."""
    q = torch.linspace(0.0, 1.5, 300, dtype=torch.float64)
    counts = (-30 + 310 * q / 1.5).clamp(0, 255).round()
    counts = counts if rising else 255 - counts
    calibration = HallCalibration.fit(counts[:, None], q[:, None], ["knuckle"])
    zero, full = (calibration.estimate(torch.tensor([value])) for value in (0.0, 255.0))
    closed, opened = (full, zero) if rising else (zero, full)
    assert float(opened.q) == pytest.approx(0.145 / 2, abs=0.01)  # saturated for 30 of 310 counts
    assert float(closed.q) == pytest.approx(1.5 - 0.121 / 2, abs=0.01)
    assert float(opened.std) == pytest.approx(0.145 / 12**0.5, abs=0.005)
    assert not bool(opened.valid.any() | closed.valid.any())
    assert opened.within.flatten().tolist() == pytest.approx([0.0, 0.145], abs=0.01)
    assert closed.within.flatten().tolist() == pytest.approx([1.5 - 0.121, 1.5], abs=0.01)
    assert bool(calibration.estimate(torch.tensor([120.0])).within.isinf().all())


def test_a_curve_that_turns_back_is_refused():
    n = torch.linspace(1, 254, 200, dtype=torch.float64)
    q = 1.0 - ((n - 120) / 130) ** 2
    with pytest.raises(CalibrationError, match=r"knuckle.*turns back at reading 1[12]\d\."):
        HallCalibration.fit(n[:, None], q[:, None], ["knuckle"])


def test_a_joint_that_was_not_moved_is_refused():
    n = torch.linspace(1, 254, 50, dtype=torch.float64)[:, None]
    with pytest.raises(CalibrationError, match="less than 10 deg"):
        HallCalibration.fit(n, 0.1 * n / 254, ["knuckle"])
    mostly = torch.where(torch.arange(50)[:, None] < 45, 255.0, n)
    with pytest.raises(CalibrationError, match="only 5 unsaturated"):
        HallCalibration.fit(mostly, n / 150, ["knuckle"])


@pytest.mark.parametrize("failure", [0.0, 255.0, math.nan])
def test_stuck_channels(hand, generator, failure):
    sensors = HallSensors(hand, seed=2)
    sensors.stuck[4] = failure
    readings, _ = sensors.sweep(60, generator)
    assert len(readings[:, 4].unique()) == 1
    marked = calibrated(sensors)
    assert [channel.stuck for channel in marked.channels] == [k == 4 for k in range(15)]
    sound_again = readings.clone()
    sound_again[:, 4] = 100.0  # it was stuck when calibrated: nothing that it says is believed
    estimate = marked.estimate(sound_again)
    assert not bool(estimate.valid[:, 4].any())
    assert bool(estimate.std[:, 4].gt(20 * DEG).all())
    sensors.stuck.clear()
    assert len(sensors.sweep(60, generator)[0][:, 4].unique()) > 8


def test_bad_samples_are_refused(hand, generator):
    sensors = HallSensors(hand)
    readings, angles = sensors.sweep(60, generator)
    bad = angles.clone()
    bad[3, 2] = torch.nan
    for call, error, match in (
        ((readings[:, :5], angles, sensors.joints), ShapeError, "readings"),
        ((readings, angles[:7], sensors.joints), ShapeError, "angles"),
        ((readings, bad, sensors.joints), NonFiniteError, "angles"),
        ((readings + 10, angles, sensors.joints), ParameterError, "0..255"),
    ):
        with pytest.raises(error, match=match):
            HallCalibration.fit(*call)
    calibration = HallCalibration.fit(readings, angles, sensors.joints)
    with pytest.raises(ShapeError, match="15"):
        calibration.estimate(torch.zeros(3))
    with pytest.raises(NonFiniteError):
        calibration.estimate(torch.full((15,), torch.nan))
    with pytest.raises(ShapeError, match=str(hand.n_q)):
        sensors.read(torch.zeros(3), generator)
    with pytest.raises(ParameterError, match="hall_sensors"):
        HallSensors(dataclasses.replace(hand, hall_sensors=()))


# -- all joints together --------------------------------------------------------------------------


def encoders(hand, q, generator, std=0.5 * DEG):
    a = q @ torch.from_numpy(hand.actuation_jacobian).mT + torch.from_numpy(hand.actuator_offset)
    return a + std * torch.randn(a.shape, generator=generator, dtype=torch.float64)


def test_joint_estimates_of_a_whole_hand(hand, generator, monkeypatch):
    monkeypatch.setattr(joint_estimator, "ENCODER_STD", 0.5 * DEG)
    monkeypatch.setattr(joint_estimator, "ARM_STD", 0.0)
    sensors = HallSensors(hand, seed=1)
    estimator = JointEstimator(hand, calibrated(sensors))
    q = random_posture(hand, 400, generator)
    estimate = estimator(sensors.read(q, generator), encoders(hand, q, generator))
    error = estimate.q - q
    rms = error.square().mean(0).sqrt() / DEG
    assert float(rms.max()) < 0.7  # also the joints that have no channel: thumb_0 and the abductions
    moving = torch.from_numpy(hand.joint_upper - hand.joint_lower) > 1e-3
    variance = estimate.covariance.diagonal(dim1=-2, dim2=-1)
    chi2 = (error.square() / variance).mean(0)[moving]
    assert bool(((chi2 > 0.4) & (chi2 < 2.0)).all())


def test_wrong_moment_arms_do_not_draw_joints_that_have_channels(hand, generator) -> None:
    """Cables that move joints by a quarter less than described: J_a q + a_0 and a are 20 to 40 deg apart."""
    sensors = HallSensors(hand, seed=1)
    q = random_posture(hand, 200, generator)
    a = encoders(hand, q, generator)
    offset = torch.from_numpy(hand.actuator_offset)
    worn = offset + 1.3 * (a - offset)
    worn[:, :2], worn[:, -1] = a[:, :2], a[:, -1]
    error = (JointEstimator(hand, calibrated(sensors))(sensors.read(q, generator), worn).q - q) / DEG
    mean = error.mean(0).abs()
    for joint in ("index_2", "index_3", "middle_2", "middle_3", "thumb_2", "thumb_3"):
        assert float(mean[hand.joint_names.index(joint)]) < 0.2


def test_encoders_stand_in_for_a_stuck_channel(hand, generator, monkeypatch):
    monkeypatch.setattr(joint_estimator, "ENCODER_STD", 0.5 * DEG)
    monkeypatch.setattr(joint_estimator, "ARM_STD", 0.0)
    sensors = HallSensors(hand, seed=1)
    sensors.stuck[4] = 255.0  # index_2, which the encoder of index_distal covers with index_3
    estimator = JointEstimator(hand, calibrated(sensors))
    q = random_posture(hand, 200, generator)
    estimate = estimator(sensors.read(q, generator), encoders(hand, q, generator))
    k = hand.joint_names.index("index_2")
    assert float((estimate.q - q)[:, k].square().mean().sqrt()) < 1.2 * DEG
    assert float(estimate.covariance[:, k, k].sqrt().mean()) < 1.2 * DEG


def test_a_saturated_channel_holds_what_cables_get_wrong(hand, generator):
    sensors = HallSensors(hand, seed=1)
    calibration = calibrated(sensors)
    k = hand.joint_names.index("middle_2")
    channel = calibration.joints.index("middle_2")
    q = random_posture(hand, 1, generator)
    q[:, k] = 0.0
    counts = sensors.read(q, generator)
    counts[:, channel] = 255.0  # the joint is open
    end = float(calibration.estimate(counts).within[1, 0, channel])
    cable = hand.actuator_names.index("middle_distal")
    for off in (0.0, 40.0):  # of the cable [deg]
        a = encoders(hand, q, generator)
        a[:, cable] += off * DEG
        assert float(JointEstimator(hand, calibration)(counts, a).q[0, k]) <= end


def test_estimator_refuses_what_does_not_fit(hand, generator):
    sensors = HallSensors(hand)
    calibration = calibrated(sensors)
    planar = load_hand("planar_two_finger")
    with pytest.raises(JointMismatchError, match="thumb_2"):
        JointEstimator(planar, calibration)
    estimator = JointEstimator(hand, calibration)
    with pytest.raises(ShapeError, match="actuators"):
        estimator(torch.full((15,), 100.0), torch.zeros(4))
    with pytest.raises(NonFiniteError, match="actuators"):
        estimator(torch.full((15,), 100.0), torch.full((hand.n_a,), torch.inf))


def test_couplings_of_an_estimate_hold_from_the_rest_on(hand):
    rest = np.zeros(20)
    rest[hand.joint_names.index("ring_0")] = 0.1
    other = dataclasses.replace(hand, spring_rest=rest)
    sensors = HallSensors(other, seed=0)
    counts = sensors.read(torch.from_numpy(rest)[None], torch.Generator().manual_seed(0))
    q = JointEstimator(other, calibrated(sensors))(counts, torch.from_numpy(hand.actuator_offset)[None]).q[0]
    apart = torch.from_numpy(hand.coupling) @ (q - torch.from_numpy(rest))
    assert float(apart.abs().max()) < 1e-3
