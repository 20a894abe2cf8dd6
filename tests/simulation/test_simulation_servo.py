"""The position controller and its faults."""

import numpy as np
import pytest

from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError
from torch_ekm.simulation import PlantParameters
from torch_ekm.simulation.mechanism.servo import Servo


def make(bias=0.0, relative_to="encoder", **faults):
    servo = Servo(np.zeros(3), np.full(3, 1.5), PlantParameters(**faults), relative_to)
    servo.bias = np.full(3, bias)
    servo.place(np.full(3, 0.5))
    return servo


def command(servo, delta, seed=0):
    servo.move_to(servo.plan(np.asarray(delta), np.random.default_rng(seed)))
    return servo.encoder


@pytest.mark.parametrize(
    ("faults", "delta", "goes"),
    [
        ({}, [0.1, -0.2, 0.0], [0.6, 0.3, 0.5]),
        ({}, [5.0, -5.0, 0.0], [1.5, 0.0, 0.5]),
        ({"dead_zone": 0.02}, [0.05, -0.05, 0.015], [0.53, 0.47, 0.5]),
    ],
    ids=["as told", "to its limits", "short of it"],
)
def test_where_a_servo_goes(faults, delta, goes):
    np.testing.assert_allclose(command(make(**faults), delta), goes)


def test_bias_drifts_relative_to_the_encoder_and_does_not_on_the_setpoint():
    drifting, steady = make(bias=0.01), make(bias=0.01, relative_to="setpoint")
    for _ in range(5):
        a, b = command(drifting, [0.0, 0.0, 0.02]), command(steady, [0.0, 0.0, 0.02])
    np.testing.assert_allclose(a, [0.55, 0.55, 0.65])
    np.testing.assert_allclose(b, [0.51, 0.51, 0.61])


def test_fresh_error_is_bounded_seeded_and_drawn_anew():
    servo = make(actuator_error=0.01)
    first = command(servo, np.zeros(3), seed=1)
    assert 0 < np.abs(first - 0.5).max() <= 0.01
    servo.place(np.full(3, 0.5))
    np.testing.assert_array_equal(command(servo, np.zeros(3), seed=1), first)
    servo.place(np.full(3, 0.5))
    assert not np.array_equal(command(servo, np.zeros(3), seed=2), first)


def test_small_increments_pile_up_on_the_setpoint_but_never_on_the_encoder():
    stuck, patient = make(dead_zone=0.02), make(dead_zone=0.02, relative_to="setpoint")
    for _ in range(10):
        a, b = command(stuck, [0.01] * 3), command(patient, [0.01] * 3)
    np.testing.assert_allclose(a, 0.5)
    np.testing.assert_allclose(b, 0.58)


def test_backlash_is_a_play_between_motor_and_tendon():
    servo = make(backlash=0.02)
    for motor, output in ((0.505, 0.5), (0.53, 0.52), (0.515, 0.52), (0.5, 0.51)):
        servo.move_to(np.full(3, motor))
        np.testing.assert_allclose(servo.output, output)
        np.testing.assert_allclose(servo.encoder, motor)


def test_other_faults_leave_the_motors_where_they_are():
    servo = make(backlash=0.02, relative_to="setpoint")
    command(servo, [0.1, 0.2, -0.1])
    servo.set_parameters(PlantParameters(dead_zone=0.1))
    np.testing.assert_allclose(servo.encoder, [0.6, 0.7, 0.4])
    np.testing.assert_allclose(servo.output, [0.59, 0.69, 0.41])
    np.testing.assert_allclose(servo.setpoint, [0.6, 0.7, 0.4])


@pytest.mark.parametrize(("delta", "error"), [([0.1, 0.1], ShapeError), ([0.1, np.nan, 0.1], NonFiniteError)])
def test_bad_commands_change_nothing(delta, error):
    servo = make()
    with pytest.raises(error):
        command(servo, delta)
    np.testing.assert_allclose(servo.setpoint, 0.5)
    np.testing.assert_allclose(servo.encoder, 0.5)


def test_unknown_reference_is_refused():
    with pytest.raises(ParameterError, match="'encoder' or 'setpoint'"):
        make(relative_to="memory")
