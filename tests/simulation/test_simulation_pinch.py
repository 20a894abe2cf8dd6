"""Planned pinches against an independent account of contacts and forces; what would make one hold."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from made_hands import write_hand
from simulation_helpers import DEG

from torch_ekm.contact.detector import ContactDetector
from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import EquilibriumError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.simulation import PlantConfig, PlantParameters, SimulatedHand
from torch_ekm.simulation.grasp_planning import pinch
from torch_ekm.simulation.grasp_planning.pinch import (
    _guesses,
    opposing_pads,
    pinch_problem,
    plan_pinch,
    remembered_pinch,
    turning_axis,
)
from torch_ekm.simulation.grasp_planning.pinch_problem import PinchRequest
from torch_ekm.simulation.mechanism.assembly import make_transmission

G = 9.81


@functools.cache  # two tests look at the same plans
def plan_for(name, request=None, **changes):
    hand, obj = load_hand("icub_right"), load_object(name)
    parameters = PlantParameters(**changes)
    problem = pinch_problem(hand, obj, PlantConfig(), parameters)
    plan = plan_pinch(problem, request or PinchRequest())
    return hand, obj, plan, make_transmission(hand, parameters)


def contacts_of(hand, obj, plan):
    parts = (torch.from_numpy(part) for part in (plan.q, plan.position, plan.rotation))
    return ContactDetector(hand, obj)(*parts)


@pytest.mark.parametrize(("name", "axis"), [("icub_left", (0, 1, 0)), ("yale_t42", (0, 0, 1))])
def test_an_object_lies_along_the_axis_about_which_fingers_bend(name, axis):
    hand = dataclasses.replace(load_hand(name), planar_normal=None)
    np.testing.assert_array_equal(turning_axis(hand, PlantConfig()), axis)
    np.testing.assert_allclose(turning_axis(hand, PlantConfig(along=(2, 0, 0))), (1, 0, 0))


@pytest.mark.parametrize("name", ["toothpaste", "applier", "bottle", "can", "pen_case", "carton"])
def test_a_plan_is_an_equilibrium(name):
    hand, obj, plan, transmission = plan_for(name)
    seen = contacts_of(hand, obj, plan)
    assert seen.finger == plan.pads == ("thumb", "index", "middle")
    assert seen.gap.abs().max() < 2e-5
    np.testing.assert_allclose(seen.point.numpy(), plan.points, atol=1e-4)
    np.testing.assert_allclose(seen.normal.numpy(), plan.normals, atol=1e-3)

    weight = obj.mass * np.array([0.0, 0.0, G])
    np.testing.assert_allclose(plan.forces.sum(axis=0) + weight, 0.0, atol=0.01)
    moments = np.cross(plan.points, plan.forces).sum(axis=0)
    centre = plan.position + plan.rotation @ obj.com
    np.testing.assert_allclose(moments + np.cross(centre, weight), 0.0, atol=3e-4)

    q, kinematics = torch.from_numpy(plan.q), HandKinematics(hand)
    load = np.zeros(hand.n_q)  # virtual work of the reactions, through the link's own Jacobian
    for link, point, force in zip(seen.link, plan.points, plan.forces, strict=True):
        pose = kinematics(q).of(link)
        local = pose[:3, :3].T @ (torch.from_numpy(point) - pose[:3, 3])
        load -= kinematics.jacobian(q, link, local)[:3].numpy().T @ force
    balance = load + transmission.drive_stiffness * (transmission.drive_targets(plan.q, plan.motor) - plan.q)
    loaded = [hand.joint_names.index(f"{finger}_{k}") for finger in plan.pads for k in (1, 2, 3)]
    np.testing.assert_allclose(balance[loaded], 0.0, atol=2e-3)


@pytest.mark.parametrize("name", ["toothpaste", "applier", "bottle", "can", "pen_case", "carton"])
def test_a_plan_keeps_well_inside_cones_and_stops(name):
    hand, obj, plan, _ = plan_for(name)
    normal = -np.einsum("ci,ci->c", plan.forces, plan.normals)
    tangential = np.linalg.norm(plan.forces + normal[:, None] * plan.normals, axis=1)
    assert (tangential < 0.6 * obj.friction * normal).all()
    assert normal[0] == pytest.approx(5.0, abs=0.1)
    spare = np.minimum(plan.q - hand.joint_lower, hand.joint_upper - plan.q)
    bent = [j for j, name in enumerate(hand.joint_names) if name[:-2] in plan.pads and name != "middle_0"]
    assert spare[bent].min() > 3.0 * DEG
    assert (plan.motor >= hand.actuator_lower - 1e-6).all()
    assert (plan.motor <= hand.actuator_upper).all()


def with_range(lower, upper):
    """The pinch of a can by the planar hand with another range of its left actuator."""
    hand, obj = load_hand("planar_two_finger"), load_object("can")
    left = dataclasses.replace(hand.actuators[0], lower=lower, upper=upper)
    hand = dataclasses.replace(hand, actuators=(left, *hand.actuators[1:]))
    return pinch_problem(hand, obj, PlantConfig(), PlantParameters())


def test_a_pinch_keeps_the_actuators_in_their_ranges(monkeypatch):
    problem = with_range(0.0, 150 * DEG)
    usual = plan_pinch(problem, PinchRequest()).motor[0]
    for lower, upper in ((0.0, usual - 8 * DEG), (usual + 8 * DEG, 150 * DEG)):
        problem = with_range(lower, upper)
        plan = plan_pinch(problem, PinchRequest())
        assert lower < plan.motor[0] < upper
    problem = with_range(149 * DEG, 150 * DEG)
    monkeypatch.setattr(pinch, "_GUESSES", 1)  # the others fail too
    with pytest.raises(EquilibriumError, match=r"actuator 'left' \(149 deg to 150 deg\) at \d+ deg"):
        plan_pinch(problem, PinchRequest())


def test_requests_are_met():
    request = PinchRequest(force=3.0, along=0.008, across=0.002, tilt=(0.05, -0.05))
    _, _, plan, _ = plan_for("box", request)
    assert -plan.forces[0] @ plan.normals[0] == pytest.approx(3.0, abs=0.05)
    local = (plan.points - plan.position) @ plan.rotation
    assert local[0, 0] == pytest.approx(0.008, abs=1e-3)
    assert local[1:, 0].mean() == pytest.approx(0.008, abs=1e-3)
    straight = plan_for("box")[2].rotation[:, 0]
    between = np.arccos(np.clip(straight @ plan.rotation[:, 0], -1, 1))
    assert between == pytest.approx(np.hypot(0.05, 0.05), abs=0.03)


def test_a_pinch_across_another_axis_is_not_passed_off_as_the_wanted_one(tmp_path, monkeypatch):
    size = (0.12, 0.10, 0.025)  # 100 mm along the grasp axis (y), 25 mm across it
    (tmp_path / "slab.urdf").write_text(
        '<robot name="slab"><link name="slab"><inertial><mass value="0.05"/>'
        '<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial><collision>'
        f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry></collision></link></robot>'
    )
    settings = tmp_path / "slab.object.toml"
    settings.write_text('[object]\nname = "slab"\nfriction = 0.8\ngrasp_width = 0.1\n')
    hand, slab = load_hand("planar_two_finger"), str(tmp_path / "slab.urdf")
    monkeypatch.setattr(pinch, "_GUESSES", 1)  # the others fail too
    with pytest.raises(EquilibriumError, match=r"'slab'|grasp_axis"):
        plan_pinch(pinch_problem(hand, load_object(slab), PlantConfig(), PlantParameters()), PinchRequest())
    monkeypatch.undo()
    settings.write_text(settings.read_text() + "grasp_axis = [0.0, 0.0, 1.0]\n")
    problem = pinch_problem(hand, load_object(slab), PlantConfig(), PlantParameters())
    plan = plan_pinch(problem, PinchRequest())
    assert abs(plan.normals[0] @ plan.rotation[:, 2]) > 0.95


def test_a_descent_in_which_lapack_fails_begins_again(monkeypatch):
    import scipy.optimize

    calls, descend = [], scipy.optimize.least_squares

    def fails_once(*args, **options):
        calls.append(args)
        if len(calls) == 1:
            raise np.linalg.LinAlgError("SVD did not converge")
        return descend(*args, **options)

    monkeypatch.setattr(scipy.optimize, "least_squares", fails_once)
    problem = pinch_problem(load_hand("icub_right"), load_object("box"), PlantConfig(), PlantParameters())
    plan = plan_pinch(problem, PinchRequest())
    assert len(calls) > 1
    assert len(plan.pads) == 3


def test_the_opposing_pad_is_found_by_directions_not_by_order():
    hand = load_hand("icub_right")
    thumb, index, middle, *_ = (dataclasses.replace(pad, name=f"pad {k}") for k, pad in enumerate(hand.pads))
    turned = dataclasses.replace(hand, pads=(index, thumb, middle))
    assert opposing_pads(turned, PlantConfig()) == ("pad 0", ("pad 1", "pad 2"))


def test_an_index_without_a_middle_finger_has_the_others_beside_it():
    """Two hard fingers hold nothing in space."""
    hand = load_hand("icub_right")
    thumb, index, middle, *_ = hand.pads
    pads = thumb, index, dataclasses.replace(middle, name="medium")
    found = opposing_pads(dataclasses.replace(hand, pads=pads), PlantConfig())
    assert found == ("thumb", ("index", "medium"))
    assert opposing_pads(hand, PlantConfig()) == ("thumb", ("index", "middle"))


def test_a_pad_on_the_side_of_the_one_that_opposes_is_idle(tmp_path):
    hand = load_hand(write_hand("servos", tmp_path))
    pads = tuple(dataclasses.replace(pad, name=f"pad {pad.name}") for pad in hand.pads)
    hand = dataclasses.replace(hand, pads=pads)
    assert opposing_pads(hand, PlantConfig())[0] == "pad thumb"
    pads = tuple(dataclasses.replace(pad, name=pad.name.replace("pad index", "thumb")) for pad in pads)
    assert opposing_pads(dataclasses.replace(hand, pads=pads), PlantConfig()) == ("thumb", ("pad thumb",))


def test_an_object_that_no_pinch_holds_is_refused_once(tmp_path, monkeypatch):
    (tmp_path / "bead.urdf").write_text(
        '<robot name="bead"><link name="bead"><inertial><mass value="0.003"/>'
        '<inertia ixx="1e-8" ixy="0" ixz="0" iyy="1e-8" iyz="0" izz="1e-8"/></inertial><collision>'
        '<geometry><box size="0.004 0.004 0.004"/></geometry></collision></link></robot>'
    )
    (tmp_path / "bead.object.toml").write_text(
        '[object]\nname = "bead"\nfriction = 0.9\ngrasp_width = 0.004\n'
    )
    monkeypatch.setattr(pinch, "_GUESSES", 1)  # the others fail too
    plant = SimulatedHand("icub_right", str(tmp_path / "bead.urdf"), engine="mujoco")
    descents, descend = [], pinch.descend
    monkeypatch.setattr(pinch, "descend", lambda *what, **how: descents.append(1) or descend(*what, **how))
    with pytest.raises(EquilibriumError, match="too small: 4 mm, for pads 'index' and 'middle'"):
        plant.reset(0)
    assert (often := len(descents)) > 0
    with pytest.raises(EquilibriumError, match="too small"):
        plant.reset(1)
    assert len(descents) == often


@pytest.mark.usefixtures("planned_anew")
def test_a_known_pinch_is_that_which_would_be_planned(monkeypatch):
    wanted, planned, plan = PinchRequest(along=0.004), [], pinch.plan_pinch
    anew = plan(with_range(0.0, 150 * DEG), wanted)
    monkeypatch.setattr(pinch, "_plans", {})
    monkeypatch.setattr(pinch, "plan_pinch", lambda *what: planned.append(1) or plan(*what))
    first = remembered_pinch(with_range(0.0, 150 * DEG), wanted)
    for values in vars(first).values():
        if isinstance(values, np.ndarray):
            values += 1.0  # whoever has it may change it
    again = remembered_pinch(with_range(0.0, 150 * DEG), wanted)
    assert len(planned) == 1
    for name, values in vars(anew).items():
        np.testing.assert_array_equal(values, getattr(again, name))
    remembered_pinch(with_range(0.0, 150 * DEG), PinchRequest(along=0.005))
    remembered_pinch(with_range(0.0, 149 * DEG), wanted)
    assert len(planned) == 3
    monkeypatch.setattr(pinch, "_MOST_PLANS", 3)
    remembered_pinch(with_range(0.0, 148 * DEG), wanted)  # takes the place of the oldest
    remembered_pinch(with_range(0.0, 150 * DEG), wanted)
    assert len(planned) == 5


@pytest.mark.parametrize("away", [0.0, 1.0])
def test_parts_that_are_clear_of_the_object_are_not_asked_for_a_derivative(away):
    """The same Jacobian as with all of them, near the object and 1 m off."""
    hand, obj, request = load_hand("icub_right"), load_object("can"), PinchRequest()
    problem = pinch_problem(hand, obj, PlantConfig(), PlantParameters())
    x = next(_guesses(problem, request))
    x[len(problem.moving)] += away
    clearance, steps = problem.geometry(x[None]).clearance, 1e-6 * np.eye(len(x))
    assert (clearance < 0.002).any() == (away == 0)
    values = problem.residuals(np.concatenate([x + steps, x - steps]), request, True)
    expected = (values[: len(x)] - values[len(x) :]).T / 2e-6
    np.testing.assert_array_equal(problem.jacobian(x, request, True), expected)


def test_planning_takes_one_thread_and_gives_the_others_back(monkeypatch):
    hand, obj, request, seen = load_hand("icub_right"), load_object("can"), PinchRequest(), set()
    problem = pinch_problem(hand, obj, PlantConfig(), PlantParameters())
    residuals = problem.residuals
    monkeypatch.setattr(problem, "residuals", lambda *of: seen.add(torch.get_num_threads()) or residuals(*of))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        pinch.descend(problem, request, next(_guesses(problem, request)), ranges=False)
        assert seen == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
