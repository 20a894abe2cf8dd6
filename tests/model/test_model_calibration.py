"""Calibration on exact recordings of a toy hand; what it cannot tell, in words; the files it writes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from model_toys import three_finger

from torch_ekm.description import ContactPad, load_hand, write_transmission
from torch_ekm.exceptions import DescriptionError, ParameterError, StateError, UnknownNameError
from torch_ekm.kinematics import Play
from torch_ekm.model import KinematicModel, calibrate
from torch_ekm.model.calibration.calibrate import Evidence, rests
from torch_ekm.model.calibration.parameters import PRIORS, Unknowns

F64 = torch.float64


class Toy:
    """The true hand, exact recordings of it, and models of hands with other figures."""

    def __init__(self, stiffness: float = 2e4) -> None:
        toy = three_finger(stiffness=stiffness)
        pads = tuple(
            ContactPad(name, link, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.008)
            for name, link in zip(toy.contacts.finger, toy.contacts.link, strict=True)
        )
        self.hand = dataclasses.replace(toy.model.hand, pads=pads)
        self.solver, self.at = toy.solver(), toy.equilibrium()
        self.toy = toy

    def model(self, hand) -> KinematicModel:
        """Contacts are exact functions of the state."""
        old = self.toy.model
        detector = lambda q, o, R: self.solver.surfaces(q, o, R)  # noqa: E731
        return KinematicModel(hand, old.obj, old.options, kinematics=old.kinematics, detector=detector)

    def recordings(self, steps, play=None):
        """Random positions of the tendons around the start [m]; encoders are before the play."""
        draw = np.random.default_rng(0)
        at, observations = self.at, []
        motor = at.a.clone()
        play = Play(torch.zeros(3, dtype=F64)) if play is None else play
        state = play.at(torch.zeros(3, dtype=F64))
        for k in range(steps + 1):
            if k:
                goal = self.at.a + torch.from_numpy(draw.uniform(-2e-4, 2e-4, 3)) / self.toy.unit
                moved, state = play.advance(state, goal - motor)
                motor, at = goal, self.solver.moved(at, at.a + moved)
            normal = self.solver.forces(at).normal
            seen = {**vars(at.state), "a": motor, "fingertip_force": normal, "status": "held"}
            observations.append(SimpleNamespace(**seen))
        return [SimpleNamespace(observations=observations)]

    def wrong(self):
        """Springs, arms and stiffnesses each off by 10 to 30 %."""
        draw = np.random.default_rng(0)

        def factor(*shape):
            return 1 + draw.uniform(0.1, 0.3, shape) * draw.choice([-1, 1], shape)

        hand = self.hand
        actuators = tuple(
            dataclasses.replace(actuator, stiffness=actuator.stiffness * float(factor()))
            for actuator in hand.actuators
        )
        return dataclasses.replace(
            hand,
            actuators=actuators,
            actuation_jacobian=hand.actuation_jacobian * factor(*hand.actuation_jacobian.shape),
            spring_stiffness=hand.spring_stiffness * factor(hand.n_q),
        )


@pytest.fixture(scope="module")
def toy():
    return Toy()


def test_wrong_figures_are_found_again(toy):
    calibration = calibrate(
        toy.model(toy.wrong()), toy.recordings(steps=5), ("springs", "moment_arms", "stiffness")
    )
    truth = {
        "springs": toy.hand.spring_stiffness,
        "moment_arms": toy.hand.actuation_jacobian,
        "stiffness": np.array([actuator.stiffness for actuator in toy.hand.actuators]),
    }
    rows = zip(calibration.unknowns.parameters, calibration.parameters, strict=True)
    errors = [
        abs(row.value / truth[p.kind][p.index] - 1)
        for p, row in rows
        if row.identifiable and row.standard_error < 0.01 * abs(row.value)
    ]
    assert len(errors) > 0.8 * len(calibration.unknowns)
    told_nothing = dataclasses.replace(calibration, covariance=np.eye(len(calibration.x)))
    assert not any(row.identifiable for row in told_nothing.parameters)
    assert max(errors) < 0.03
    before, after = (np.linalg.norm(e) for e in (calibration.errors_before, calibration.errors_after))
    assert after < 0.03 * before
    np.testing.assert_allclose(
        calibration.hand.actuation_jacobian, toy.hand.actuation_jacobian, rtol=0.03, atol=1e-9
    )


KINDS = ("springs", "rest", "moment_arms", "stiffness", "offset", "backlash")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("exact_force_problems")
def test_the_derivative_of_the_residuals(toy, kind, monkeypatch):
    hand = toy.wrong()
    actuators = tuple(dataclasses.replace(actuator, backlash=1e-2) for actuator in hand.actuators)
    hand = dataclasses.replace(hand, actuators=actuators)
    monkeypatch.setitem(PRIORS, "offset", 1e-1)
    monkeypatch.setitem(PRIORS, "backlash", 1e-2)
    unknowns = Unknowns(hand, [kind])
    evidence = Evidence(toy.model(hand), rests(toy.recordings(steps=3)), unknowns)
    x = np.full(len(unknowns), 0.02)
    slope = evidence.at(x).jacobian
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-4
        ends = [evidence.at(x + sign * step).value for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-4
        assert np.abs(slope[:, k] - expected).max() < 1e-3 * np.abs(expected).max() + 1e-6, (
            unknowns.parameters[k]
        )


def test_play_is_found(toy, monkeypatch):
    monkeypatch.setitem(PRIORS, "backlash", 1e-2)
    width = torch.tensor([1e-4, 5e-5, 0.0], dtype=F64) / toy.toy.unit
    recordings = toy.recordings(steps=6, play=Play(width))
    calibration = calibrate(toy.model(toy.hand), recordings, ["backlash"])
    found = calibration.hand.actuator_backlash
    np.testing.assert_allclose(found, width, atol=3e-4)
    assert np.linalg.norm(calibration.errors_after) < 0.2 * np.linalg.norm(calibration.errors_before)


def test_one_joint_or_one_actuator_can_be_chosen(toy):
    unknowns = Unknowns(toy.hand, ["springs:j1", "moment_arms:a2", "stiffness"])
    labels = [p.label for p in unknowns.parameters]
    assert labels[0] == "spring of j1"
    assert all(label.startswith("moment arm of a2 at ") for label in labels[1:-3])
    hand = unknowns.described(np.full(len(labels), 1.0))
    assert hand.spring_stiffness[1] == pytest.approx(np.exp(0.5) * toy.hand.spring_stiffness[1])
    assert hand.spring_stiffness[0] == toy.hand.spring_stiffness[0]


def test_bad_input_is_refused(toy):
    model, recordings = toy.model(toy.hand), toy.recordings(steps=1)
    with pytest.raises(UnknownNameError, match="moment_arms"):
        calibrate(model, recordings, ["pulleys"])
    with pytest.raises(UnknownNameError, match="j0"):
        calibrate(model, recordings, ["springs:thumb"])
    with pytest.raises(ParameterError):
        calibrate(model, recordings, [])
    recordings[0].observations[1].status = "lost"
    with pytest.raises(StateError, match="no motion of the recordings can be used"):
        calibrate(model, recordings, ["springs"])


@pytest.mark.parametrize("name", ["icub_right", "planar_two_finger"])
def test_a_written_transmission_reads_back(name, tmp_path):
    hand = load_hand(name)
    actuators = tuple(
        dataclasses.replace(actuator, stiffness=1.0 + k, backlash=0.01 * k, offset=0.1 * k)
        for k, actuator in enumerate(hand.actuators)
    )
    changed = dataclasses.replace(
        hand,
        actuators=actuators,
        actuation_jacobian=1.1 * hand.actuation_jacobian,
        spring_stiffness=0.9 * hand.spring_stiffness,
        spring_rest=hand.spring_rest - 0.1,
    )
    write_transmission(changed, tmp_path / "mine.transmission.toml")
    back = load_hand(tmp_path / "mine.urdf")
    assert back.actuators == changed.actuators
    for field in dataclasses.fields(changed):
        one, other = getattr(changed, field.name), getattr(back, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)
        elif field.name not in ("urdf", "transmission_path"):
            assert one == other, field.name
    with pytest.raises(DescriptionError, match="end in"):
        write_transmission(changed, tmp_path / "mine.toml")
