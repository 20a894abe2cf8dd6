"""Every wrong input has a typed error that names it; what can be read rightly is."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from model_icub import gripped
from model_toys import F64, batch_of, changed, planar_two_finger, relative_error, stacked, three_finger

from torch_ekm.contact import ContactSet
from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import (
    DescriptionError,
    EKMError,
    NonFiniteError,
    ParameterError,
    ShapeError,
    UnknownNameError,
)
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, ModelOptions

pytestmark = pytest.mark.usefixtures("unchecked")  # input that annotations forbid

TOY = three_finger()
MODEL, STATE, CONTACTS = TOY.model, TOY.state, TOY.contacts
EYE, NAN = torch.eye(3, dtype=F64), float("nan")
HAND, BOX = load_hand("planar_two_finger"), load_object("box")


def state(rotation):
    return GraspState(STATE.q, STATE.position, rotation)


def posture(q):
    return GraspState(q, STATE.position, EYE)


def with_contacts(**changes):
    return MODEL.linearize(STATE, CONTACTS.replace(**changes))


def at(field, value, where=1):
    tensor = getattr(CONTACTS, field).clone()
    tensor[where] = value
    return {field: tensor}


def for_two(**options):
    return MODEL.linearize(batch_of(STATE, STATE), **options)


def expecting(n):
    """The forces after n increments."""
    return MODEL.linearize(STATE, expected=MODEL.linearize(STATE).forces_after(torch.zeros(n, 3, dtype=F64)))


def felt(force):
    pads = tuple(dataclasses.replace(HAND.pads[0], name=name) for name in CONTACTS.finger)
    return changed(MODEL, pads=pads).linearize(STATE, fingertip_force=force)


def hand(**changes):
    return dataclasses.replace(HAND, **changes)


def box(**changes):
    return dataclasses.replace(BOX, **changes)


WRONG = {
    "reflection": (lambda: state(-EYE), ParameterError, "reflec"),
    "rotation scaled": (lambda: state(2 * EYE), ParameterError, "rotation matrix"),
    "rotation of a batch": (
        lambda: GraspState(STATE.q.expand(2, -1), STATE.position.expand(2, -1), torch.stack([EYE, 2 * EYE])),
        ParameterError,
        "rotation",
    ),
    "words": (lambda: GraspState(["left"], STATE.position, EYE), ParameterError, "numbers"),
    "ragged list": (lambda: GraspState([[0.1], [0.1, 0.2]], STATE.position, EYE), ParameterError, "numbers"),
    "one angle": (lambda: GraspState(torch.tensor(0.3), [0, 0, 0], EYE), ShapeError, "q must"),
    "joints of another hand": (lambda: MODEL.linearize(posture(STATE.q[:5])), ShapeError, "j8"),
    "motors of another hand": (lambda: MODEL(STATE, torch.zeros(4, dtype=F64)), ShapeError, "delta_a"),
    "float32 state": (lambda: MODEL.linearize(_single(STATE)), ParameterError, "float64"),
    "NaN in points": (lambda: with_contacts(**at("point", NAN)), NonFiniteError, r"contacts\.point"),
    "link of another hand": (lambda: with_contacts(link=("f9",) * 3), UnknownNameError, "f9"),
    "contacts of one state": (lambda: for_two(contacts=CONTACTS), ShapeError, "gap"),
    "no contacts of two states": (for_two, ShapeError, "contacts"),
    "forces of two states": (lambda: expecting(2), ShapeError, r"expected\.force"),
    "NaN in curvature": (lambda: with_contacts(**at("finger_curvature", NAN)), NonFiniteError, "finger_c"),
    "negative friction": (lambda: with_contacts(**at("friction", -0.5)), ParameterError, "f1_l2"),
    "negative gamma": (lambda: with_contacts(**at("torsional_friction", -1e-3)), ParameterError, "torsional"),
    "normal too long": (lambda: with_contacts(normal=1.1 * CONTACTS.normal), ParameterError, "not 1.1"),
    "curvature misshapen": (lambda: with_contacts(object_curvature=EYE), ShapeError, "object_curvature"),
    "link missing": (lambda: CONTACTS.replace(link=("f0_l2",)), ShapeError, "link"),
    "NaN mass": (lambda: _held(mass=NAN), ParameterError, "mass"),
    "NaN centre of mass": (lambda: _held(com=np.array([0.0, NAN, 0.0])), ParameterError, "com"),
    "NaN mass in a file": (lambda: box(mass=NAN), DescriptionError, "mass"),
    "negative friction in a file": (lambda: box(friction=-1), DescriptionError, "friction"),
    "inertia of no body": (lambda: box(inertia=np.diag([1e-5, 1e-5, 3e-5])), DescriptionError, "sum of the"),
    "NaN step": (lambda: MODEL.linearize(STATE).step([0.1, NAN, 0.0]), NonFiniteError, "delta_a"),
    "fingertips of another hand": (lambda: felt([1.0, 2.0]), ShapeError, "fingertip_force"),
    "negative fingertip force": (lambda: felt([1.0, -2.0, 1.0]), ParameterError, "fingertip_force"),
    "infinite fingertip force": (lambda: felt([1.0, math.inf, 1.0]), ParameterError, "fingertip_force"),
    "zero planar normal": (lambda: hand(planar_normal=(0, 0, 0)), DescriptionError, "zero"),
    "planar normal across the axes": (lambda: hand(planar_normal=(0, 0.1, 1)), DescriptionError, "left_0"),
    "name of a hand": (lambda: KinematicModel("icub_right", BOX), ParameterError, "load_hand"),
    "name of an object": (lambda: KinematicModel(HAND, "box"), ParameterError, "load_object"),
    "object and hand swapped": (lambda: KinematicModel(BOX, HAND), ParameterError, "load_hand"),
    "hand without pads": (lambda: KinematicModel(hand(pads=()), BOX), DescriptionError, "pads"),
    "word for unstable": (lambda: ModelOptions(on_unstable="ignore"), ParameterError, "on_unstable"),
    "margin": (lambda: ModelOptions(contact_margin=-1.0), ParameterError, "contact_margin"),
    "overlap": (lambda: ModelOptions(max_overlap=0.0), ParameterError, "max_overlap"),
    "slack tension": (lambda: ModelOptions(slack_tension=-1.0), ParameterError, "slack_tension"),
}


def _single(s):
    return GraspState(s.q.float(), s.position.float(), s.rotation.float())


def _held(**changes):
    return changed(MODEL, obj=dataclasses.replace(MODEL.obj, **changes))


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_has_a_typed_error_that_names_it(case):
    call, kind, match = WRONG[case]
    assert issubclass(kind, EKMError)
    with pytest.raises(kind, match=match):
        call()


def test_a_planar_hand_may_have_its_normal_either_way_round_and_of_any_length():
    assert hand(planar_normal=(0.0, 0.0, -2.0)).planar_normal == (0.0, 0.0, -2.0)


def test_arrays_lists_and_both_precisions_are_read():
    expected = MODEL.linearize(STATE).manipulation_jacobian
    for kind in (torch.Tensor.numpy, torch.Tensor.tolist):
        s = GraspState(*(kind(x) for x in (STATE.q, STATE.position, STATE.rotation)))
        assert torch.equal(MODEL.linearize(s).manipulation_jacobian, expected)
        fields = {f.name: getattr(CONTACTS, f.name) for f in dataclasses.fields(CONTACTS)}
        contacts = ContactSet(
            **{k: kind(v) if isinstance(v, torch.Tensor) else list(v) for k, v in fields.items()}
        )
        assert torch.equal(MODEL.linearize(STATE, contacts).manipulation_jacobian, expected)
    mixed = GraspState(STATE.q, STATE.position.float(), np.eye(3, dtype=np.float32))
    assert mixed.position.dtype == mixed.rotation.dtype == F64
    assert GraspState([0, 1], [0, 0, 0], torch.eye(3)).rotation.dtype == F64  # lists count as float64
    single = GraspState(torch.zeros(2), np.zeros(3, dtype=np.float32), torch.eye(3))
    assert single.position.dtype == torch.float32
    step = MODEL.linearize(STATE).step([0.01, 0, 0])
    assert torch.equal(step, MODEL.linearize(STATE).step(np.array([0.01, 0, 0])))
    assert torch.allclose(step, MODEL.linearize(STATE).step(torch.tensor([0.01, 0, 0])), rtol=1e-6)
    assert torch.equal(felt([1.0, NAN, 1.0]).forces.mu, felt(np.array([1.0, NAN, 1.0])).forces.mu)
    assert felt([-0.1, 0.0, 0.0]).forces.solved  # a sensor that reads a little below zero is noise


def test_a_very_stiff_actuator_is_rigid_without_false_alarm():
    model, solver, equilibrium = gripped("box")
    forces = solver.forces(equilibrium)

    def jacobian(stiffness):
        actuators = tuple(dataclasses.replace(a, stiffness=stiffness) for a in model.hand.actuators)
        stiff = changed(model, actuators=actuators)
        return stiff.linearize(equilibrium.state, equilibrium.contacts, forces=forces).manipulation_jacobian

    assert relative_error(jacobian(1e12), jacobian(math.inf), 20) < 1e-12
    assert relative_error(jacobian(9e5), jacobian(math.inf), 20) < 1e-4


def loose_tendon():
    """A tendon on each joint of the left finger: that of the first one pulls nothing; and without it."""
    J_a = np.array([[0.009, 0.0, 0, 0], [0.004, 0.008, 0, 0], [0, 0, 0.009, 0.008]])
    lam = torch.tensor([0.0, -20.0, -20.0], dtype=F64)
    return planar_two_finger(J_a=J_a, lam=lam), planar_two_finger(J_a=J_a[1:])


def test_a_slack_tendon_moves_nothing_and_holds_nothing():
    toy, without = loose_tendon()
    truth = without.model.linearize(without.state).manipulation_jacobian
    for options in ({}, {"slack_tension": 0.0}, {"slack_tension": 1e-3}):
        J = changed(toy.model, options=options).linearize(toy.state).manipulation_jacobian
        assert J[:, 0].abs().max() == 0
        assert relative_error(J[:, 1:], truth, 4) < 1e-4
    rods = changed(toy.model, options={"slack_tension": None}).linearize(toy.state).manipulation_jacobian
    assert rods[:, 0].abs().max() > 0
    assert relative_error(rods[:, 1:], truth, 4) > 0.1  # rods hold what tendons let go
    # forces that were not found say nothing about tensions
    slippery = toy.contacts.replace(friction=torch.full((2,), 0.001, dtype=F64))
    lin = toy.model.linearize(toy.state, slippery)
    assert not lin.forces.solved
    assert lin.manipulation_jacobian[:, 0].abs().max() > 0


def test_states_of_a_batch_have_their_own_slack_tendons():
    toy, _ = loose_tendon()
    forces = toy.forces()
    lam = torch.stack([toy.lam, toy.lam - 1.0])
    wide = {
        f.name: getattr(forces, f.name).expand(2, *getattr(forces, f.name).shape)
        for f in dataclasses.fields(forces)
        if f.name not in ("status", "lam", "covariance")
    }
    both = dataclasses.replace(forces, lam=lam, status=forces.status * 2, **wide)
    states, contacts = batch_of(toy.state, toy.state), stacked(toy.contacts, toy.contacts)
    J = toy.model.linearize(states, contacts, forces=both).manipulation_jacobian
    one = toy.model.linearize(toy.state, forces=forces).manipulation_jacobian
    assert torch.allclose(J[0], one, atol=1e-12)
    assert J[0, :, 0].abs().max() == 0
    assert J[1, :, 0].abs().max() > 0
