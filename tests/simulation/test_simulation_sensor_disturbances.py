"""Disturbances of the sensors: they spoil their own reading and never the truth."""

import numpy as np
import pytest
import torch
from simulation_helpers import DEG, ROLL, SQUEEZE, truth

from torch_ekm.kinematics.se3 import log
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import PlantParameters, SimulatedHand

SENSOR_DISTURBANCES = {
    "joint_noise": 1.0 * DEG,
    "position_noise": 1e-3,
    "rotation_noise": 1.0 * DEG,
    "force_noise": 0.3,
    "force_offset": 0.5,
    "force_hysteresis": 0.4,
    "force_range": 15.0,
    "latency": 0.1,
    "frame_loss": 0.5,
    "stuck_joints": ("index_3",),
}


def rolled(plant):
    """The reading 0.3 s after a motion: how long ``command`` waits depends on the sensors."""
    rig = plant._grasped()
    rig.follow((rig.servo.encoder + ROLL.numpy())[None], np.zeros(1))
    plant.wait(0.3)
    return plant.observe()


@pytest.mark.parametrize("name", SENSOR_DISTURBANCES)
def test_sensor_disturbances_touch_their_own_reading_and_never_the_truth(exact, grasped, name):
    clean = rolled(exact)
    exact.restore(grasped)
    exact.change(**{name: SENSOR_DISTURBANCES[name]})
    seen = rolled(exact)
    for key in ("q", "position", "rotation", "fingertip_force", "actuator_torque"):
        assert torch.equal(getattr(seen.truth, key), getattr(clean.truth, key)), key
    kind = name.split("_")[0]
    own = {"joint": {"q"}, "stuck": {"q"}, "force": {"fingertip_force"}, "position": {"position"}}
    own |= {"rotation": {"rotation"}, "latency": {"position", "rotation"}, "frame": {"position", "rotation"}}
    for key in ("q", "a", "position", "rotation", "fingertip_force"):
        if key not in own[kind]:
            assert torch.equal(getattr(seen, key), getattr(clean, key)), key
    if name not in ("stuck_joints", "latency", "frame_loss", "force_hysteresis"):  # see below
        assert any(not torch.equal(getattr(seen, key), getattr(clean, key)) for key in own[kind])


@pytest.mark.parametrize(
    ("name", "size", "reading"),
    [
        ("joint_noise", 0.5 * DEG, lambda o: o.q - o.truth.q),
        ("position_noise", 2e-4, lambda o: o.position - o.truth.position),
        ("rotation_noise", 0.2 * DEG, lambda o: log(o.rotation @ o.truth.rotation.mT)),
        ("force_noise", 0.1, lambda o: (o.fingertip_force - o.truth.fingertip_force)[:3]),
    ],
)
def test_noise_has_its_size_and_no_mean(exact, name, size, reading):
    exact.change(**{name: size})
    sample = torch.stack([reading(exact.observe()) for _ in range(400)])
    assert float(sample.std()) == pytest.approx(size, rel=0.1)
    assert float(sample.mean().abs()) < 5 * size / sample.numel() ** 0.5


def test_fingertips_read_in_8_bit_with_offset_and_hysteresis(exact):
    exact.change(force_range=15.0)
    readings = exact.command(SQUEEZE).fingertip_force / (15.0 / 255)
    torch.testing.assert_close(readings, readings.round(), atol=1e-9, rtol=0)
    exact.change(force_range=0.0, force_offset=0.3)
    error = exact.observe()
    error = error.fingertip_force - truth(error, "fingertip_force")
    assert 0.02 < error[:3].abs().max() <= 0.3
    exact.change(force_offset=0.0, force_hysteresis=0.4)
    exact.command(SQUEEZE)
    rising = exact.observe()
    falling = exact.command(-SQUEEZE)
    lag = [truth(o, "fingertip_force")[0] - o.fingertip_force[0] for o in (rising, falling)]
    assert lag[0] == pytest.approx(0.2, abs=1e-6)
    assert lag[1] == pytest.approx(-0.2, abs=1e-6)


def test_late_pictures_of_a_second_grasp_are_its_own():
    late = [SimulatedHand("planar_two_finger", "box", parameters=PlantParameters(latency=0.1)) for _ in "ab"]
    late[0].reset(1)
    late[0].wait(2.0)
    again, fresh = (plant.reset(0) for plant in late)
    assert torch.equal(again.position, fresh.position)
    torch.testing.assert_close(again.position, truth(again, "position"), atol=1e-5, rtol=0)


def test_the_picture_is_as_old_as_the_camera_is_late(exact):
    exact.change(latency=0.1)
    exact.wait(0.5)
    motor = exact._rig.servo.encoder
    exact._rig.run(100, lambda part: motor + part * ROLL.numpy())
    now = exact.observe()
    exact._rig.run(100, lambda part: motor + ROLL.numpy())
    then = exact.observe().truth.pictured
    for name in ("q", "position", "rotation"):
        assert torch.equal(getattr(then, name), getattr(now.truth, name))
    assert not torch.equal(now.truth.pictured.q, now.truth.q)


def test_lost_frames_repeat_the_last_pose_and_say_so(exact):
    exact.change(frame_loss=0.3)
    exact.observe()
    seen = [exact.observe() for _ in range(300)]
    lost = [o.status is PlantStatus.NOT_SEEN for o in seen]
    assert np.mean(lost) == pytest.approx(0.3, abs=0.08)


def test_the_first_frame_of_a_grasp_is_never_lost():
    plant = SimulatedHand("planar_two_finger", "box", parameters=PlantParameters(frame_loss=1.0))
    first = plant.reset(0)
    assert first.status is PlantStatus.HELD
    assert torch.equal(first.position, truth(first, "position"))
    assert plant.observe().status is PlantStatus.NOT_SEEN
    later = plant.command(torch.zeros(plant.hand.n_a))
    assert later.taken == (later.time, later.time, first.time, later.time)  # the pose is as old as it is


def test_a_stuck_channel_stays_where_it_was(exact):
    joint = exact.hand.joint_names.index("index_3")
    exact.change(stuck_joints=("index_3",))
    first = exact.observe().q[joint]
    later = exact.command(ROLL)
    assert later.q[joint] == first
    assert (truth(later)[joint] - first).abs() > 0.2 * DEG
