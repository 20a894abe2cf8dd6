"""Each disturbance changes what it should, by the right amount, and nothing else."""

import numpy as np
import pytest
import torch
from simulation_helpers import DEG, ROLL, SQUEEZE, increment, motion, truth, turned

from torch_ekm.exceptions import ParameterError
from torch_ekm.plant import Plant, PlantStatus
from torch_ekm.simulation import PRESETS, DisturbedPlant, PlantChange, PlantParameters, SimulatedHand, Tug

# -- the mechanism ------------------------------------------------------------------------------------


def test_one_pulley_changes_the_effect_of_one_actuator(exact, grasped):
    factors = [1.0] * 9
    factors[exact.hand.actuator_names.index("thumb_distal")] = 1.3
    moves = [increment(thumb_distal=-2.0), increment(index_distal=2.0)]
    nominal = []
    for delta in moves:
        exact.restore(grasped)
        nominal.append(turned(exact, delta))
    ratios = []
    for delta, reference in zip(moves, nominal, strict=True):
        exact.restore(grasped)
        exact.change(moment_arm=tuple(factors))
        ratios.append(turned(exact, delta) / reference)
    assert ratios[0] == pytest.approx(1 / 1.3, abs=0.06)
    assert ratios[1] == pytest.approx(1.0, abs=0.08)


def test_weaker_springs_let_the_fingertips_bend_back(exact):
    """Contact torques split over a tendon's two joints by their springs: ``k (q_3 - q_2)`` carries them."""
    joints = [exact.hand.joint_names.index(name) for name in ("thumb_2", "thumb_3")]
    before = truth(exact.observe())[joints].diff()
    exact.change(spring=0.8)
    exact.wait(0.5)
    assert truth(exact.observe())[joints].diff() - before > 2.0 * DEG


def test_a_softer_transmission_squeezes_less_hard(exact, grasped):
    def gain():
        before = truth(exact.observe(), "fingertip_force")[0]
        return float(truth(exact.command(SQUEEZE), "fingertip_force")[0] - before)

    stiff = gain()
    exact.restore(grasped)
    before = exact.observe()
    exact.change(servo_stiffness=0.5)
    exact.wait(0.5)
    assert motion(before, exact.observe())[0].norm() < 2e-5  # no jolt
    assert 0.3 * stiff < gain() < 0.9 * stiff


def test_joint_friction_keeps_the_way_back_apart(exact, grasped):
    def gap():
        start = exact.observe()
        exact.command(ROLL)
        return motion(start, exact.command(-ROLL))[1].norm() / DEG

    smooth = gap()
    exact.restore(grasped)
    exact.change(joint_friction=2.0)
    rough = gap()
    assert smooth < 0.1
    assert rough > 3 * smooth
    assert 0.05 < rough < 2.0


def test_finger_weight_acts_at_once(exact, grasped):
    before = exact.restore(grasped)
    exact.change(link_weight=True)
    exact.wait(1.0)
    heavy = (truth(exact.observe()) - truth(before)).abs().max()
    exact.restore(grasped)  # takes the weight off again
    exact.wait(1.0)
    light = (truth(exact.observe()) - truth(before)).abs().max()
    assert 0.02 * DEG < heavy < 3.0 * DEG
    assert light < 0.1 * heavy


# -- the object ---------------------------------------------------------------------------------------


def test_a_slippery_object_slips_at_a_tug_that_a_rough_one_stands(exact, grasped):
    slips = []
    for friction in (1.0, 0.6):
        before = exact.restore(grasped)
        exact.change(friction=friction)
        slips.append(motion(before, exact.tug(np.array([0.0, 0.0, 3.0]), np.zeros(3)))[1].norm() / DEG)
    assert slips[0] < 1.0
    assert slips[1] > 2 * slips[0]


def test_an_eccentric_object_shifts_the_load_between_the_fingers(exact, grasped):
    tilts = []
    for shift in (-0.02, 0.02):
        before = exact.restore(grasped)
        exact.change(com_shift=(shift, 0.0, 0.0), mass=2.0)
        exact.wait(0.5)
        tilts.append(float(motion(before, exact.observe())[1][0]))
    assert tilts[0] * tilts[1] < 0  # it tilts towards its heavy end, about the pinch line (x)
    assert min(map(abs, tilts)) > 0.05 * DEG


def test_a_larger_object_opens_the_fingers(monkeypatch):
    monkeypatch.setattr("torch_ekm.simulation.simulated_hand._TILT", 0.0)
    widths = []
    for scale in (1.0, 1.2):
        plant = SimulatedHand("icub_right", "box", parameters=PlantParameters(object_scale=scale))
        plant.reset(0)
        widths.append((plant.plan.points[1:].mean(axis=0) - plant.plan.points[0]) @ plant.plan.normals[1])
    assert widths[1] - widths[0] == pytest.approx(0.2 * 0.03, abs=3e-4)


# -- the position controller --------------------------------------------------------------------------


def test_backlash_hides_from_the_encoders_and_swallows_motion(exact, grasped):
    def there_and_back():
        start = exact.observe()
        exact.command(ROLL)
        end = exact.command(-ROLL)
        torch.testing.assert_close(end.a, start.a)
        return motion(start, end)[1].norm() / DEG

    tight = there_and_back()
    exact.restore(grasped)
    exact.change(backlash=1.0 * DEG)
    assert there_and_back() > max(0.2, 5 * tight)


# -- presets and events ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_grasps(name):
    plant = SimulatedHand("icub_right", "box", preset=name)
    assert plant.reset(0).status is not PlantStatus.LOST
    assert plant.command(ROLL).status is not PlantStatus.LOST


def test_events_happen_when_they_should(exact):
    tug = Tug(at=1, force=(0.0, 0.0, 5.0))
    tendons = PlantChange(2, {"moment_arm": 1.2})
    disturbed = DisturbedPlant(exact, (tendons, tug))
    assert isinstance(disturbed, Plant)
    still = torch.zeros(9)
    turns, last = [], exact.observe()
    for k in range(3):
        now = disturbed.command(still)
        turns.append(float(motion(last, now)[1].norm()) / DEG)
        assert now.info.get("events", ()) == {1: (tug,), 2: (tendons,)}.get(k, ())
        last = now
    assert turns[0] < 0.05
    assert turns[1] > 2.0  # a dislocation
    assert turns[2] < 0.2
    assert exact.parameters.moment_arm == 1.2


def test_impossible_events_and_changes_are_refused(exact):
    with pytest.raises(ParameterError, match=r"event\.at"):
        DisturbedPlant(exact, (Tug(at=-1),))
    before = exact.parameters
    for changes in ({"moment_arm": (1.0, 2.0)}, {"spring": -1.0}, {"springs": 1.0}):
        with pytest.raises(ParameterError):
            exact.change(**changes)
    assert exact.parameters == before
