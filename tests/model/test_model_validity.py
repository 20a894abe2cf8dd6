"""The model says what speaks against it: every kind of doubt, its figures and its order."""

import dataclasses

import numpy as np
import pytest
import torch
from model_icub import gripped
from model_toys import F64, batch_of, changed, soft_two_finger, stacked, three_finger

from torch_ekm.contact.contacts import NearMiss
from torch_ekm.description import Shape, load_hand, load_object
from torch_ekm.exceptions import NoContactError, NonFiniteError, ShapeError, SingularGraspError
from torch_ekm.kinematics import GraspState, HandKinematics
from torch_ekm.model import KinematicModel, ModelOptions, ModelStatus
from torch_ekm.model.validity import _of_missing_forces


def kinds(lin):
    return [doubt.kind for doubt in lin.doubts]


def test_a_sound_state_has_no_doubts(toy):
    lin = toy.model.linearize(toy.state, forces=toy.forces())
    assert lin.doubts == ()
    assert lin.status is ModelStatus.OK


def test_an_object_of_2_kg_described_as_80_g_shows_in_the_joint_torques():
    model, _, at = gripped("box")
    heavy = dataclasses.replace(model.obj, mass=2.0)  # described as 80 g
    lin = changed(model, obj=heavy).linearize(at.state, at.contacts)
    found = {doubt.kind: doubt for doubt in lin.doubts}
    doubt = found[ModelStatus.UNEXPLAINED_TORQUE]
    worst = int(lin.forces.residual.abs().argmax())
    assert doubt.what == model.hand.joint_names[worst]
    assert doubt.value == pytest.approx(float(lin.forces.residual.norm()))
    assert doubt.value > doubt.limit == pytest.approx(3 * model.options.forces.torque_std)
    assert doubt.unit == "N m"
    assert doubt.what in str(doubt)


def test_the_friction_limit_names_the_pad_and_worse_doubts_come_first(toy):
    slippery = toy.contacts.replace(
        friction=torch.full((3,), 0.36, dtype=F64), near_misses=(NearMiss("f1_l0", None, -0.0002),)
    )
    lin = toy.model.linearize(toy.state, slippery)
    assert float(lin.forces.relative_margin.min()) < 0.01
    assert kinds(lin)[0] is lin.status is ModelStatus.LINK_TOUCHES
    at_limit = [doubt.what for doubt in lin.doubts if doubt.kind is ModelStatus.FRICTION_LIMIT]
    margins = lin.forces.relative_margin.tolist()
    assert at_limit == [pad for pad, m in zip(slippery.finger, margins, strict=True) if m < 0.01]
    order = list(ModelStatus)
    assert [order.index(kind) for kind in kinds(lin)] == sorted(order.index(kind) for kind in kinds(lin))


def toy_with_pads():
    """Three fingers whose pads have the contacts' names."""
    toy = three_finger()
    pads = tuple(
        dataclasses.replace(load_hand("icub_right").pads[0], name=name, link=link)
        for name, link in zip(toy.contacts.finger, toy.contacts.link, strict=True)
    )
    return toy, changed(toy.model, pads=pads)


def test_sensors_that_disagree_with_the_balance():
    toy, model = toy_with_pads()
    normal = model.linearize(toy.state).forces.normal
    told = model.linearize(toy.state, fingertip_force=normal)
    assert ModelStatus.SENSORS_DISAGREE not in kinds(told)
    wrong = normal + torch.tensor([0.0, 3.0, 0.0], dtype=F64)
    (doubt,) = [
        d
        for d in model.linearize(toy.state, fingertip_force=wrong).doubts
        if d.kind is ModelStatus.SENSORS_DISAGREE
    ]
    assert doubt.what == toy.contacts.finger[1]
    assert doubt.value > doubt.limit == pytest.approx(0.9)
    unknown = wrong * torch.tensor([1.0, float("nan"), 1.0], dtype=F64)
    assert ModelStatus.SENSORS_DISAGREE not in kinds(model.linearize(toy.state, fingertip_force=unknown))


@pytest.mark.parametrize(
    ("gap", "measured", "before", "doubted"),
    [
        (0.0025, None, False, True),
        (0.004, None, False, False),
        (0.004, 2.0, False, True),
        (0.004, 0.2, False, False),
        (0.004, None, True, True),
    ],
)
def test_a_contact_beyond_the_margin(gap, measured, before, doubted):
    toy, model = toy_with_pads()
    model.hand = dataclasses.replace(
        model.hand, pads=(*model.hand.pads, dataclasses.replace(model.hand.pads[0], name="fourth"))
    )
    contacts = toy.contacts.replace(near_misses=(NearMiss("f2_l2", "fourth", gap),))
    force = None
    if measured is not None:
        force = torch.cat([model.linearize(toy.state).forces.normal, torch.tensor([measured], dtype=F64)])
    earlier = None
    if before:
        lin = model.linearize(toy.state)
        names = ("fourth", *lin.contacts.finger[1:])
        earlier = dataclasses.replace(lin, contacts=lin.contacts.replace(finger=names))
    lin = model.linearize(toy.state, contacts, fingertip_force=force, previous=earlier)
    found = [doubt for doubt in lin.doubts if doubt.kind is ModelStatus.CONTACT_DROPPED]
    assert bool(found) is doubted
    if doubted:
        assert (found[0].what, found[0].value) == ("fourth", gap)
        assert f"contact_margin={gap + 1e-4:.4f}" in str(found[0])


def ball_beside(link: str, gap: float, radius: float, **options):
    """A model, and a ball at a distance [m] from a finger's pad, or from the side of a link that has none."""
    hand, box = load_hand("icub_right"), load_object("box")
    kinematics = HandKinematics(hand)
    q = torch.zeros(hand.n_q, dtype=F64)
    T = kinematics(q).of(link)
    pads = [pad for pad in hand.pads if pad.link == link]
    if pads:
        at, side, own = torch.tensor([*pads[0].end, 1.0], dtype=F64), T[:3, 0], pads[0].radius
    else:
        (capsule,) = hand.urdf.link(link).collisions
        at, side, own = torch.from_numpy(capsule.transform[:, 3]), T[:3, 1], capsule.size[0]
    ball = dataclasses.replace(box, shapes=(Shape("sphere", (radius,), np.eye(4)),))
    state = GraspState(q, (T @ at)[:3] + side * (own + radius + gap), torch.eye(3, dtype=F64))
    return KinematicModel(hand, ball, ModelOptions(**options), kinematics=kinematics), state


def test_the_detector_tells_a_link_that_touches_from_one_that_does_not():
    for gap, touches in ((0.0005, True), (0.0015, False), (-0.001, True)):
        model, state = ball_beside("index_2", gap, 0.004, contact_margin=0.02)
        missed = [near for near in model.contacts(state).near_misses if near.pad is None]
        assert [near.link for near in missed] == (["index_2"] if touches else [])
        if touches:
            assert missed[0].gap == pytest.approx(gap, abs=1e-5)


def test_pads_left_out_come_with_their_gaps():
    model, state = ball_beside("index_3", 0.001, 0.01)
    contacts, pads = model.contacts(state), {pad.name: pad for pad in model.hand.pads}
    assert "index" in contacts.finger
    left_out = {near.pad: near.gap for near in contacts.near_misses if near.pad}
    assert set(left_out) == set(pads) - set(contacts.finger)
    thumb = model.kinematics(state.q).of("thumb_3") @ torch.tensor([*pads["thumb"].end, 1.0], dtype=F64)
    far = float((thumb[:3] - state.position).norm()) - 0.01 - pads["thumb"].radius
    assert left_out["thumb"] == pytest.approx(far, abs=2e-3)
    assert left_out["thumb"] > 0.002


@pytest.mark.parametrize(("gap", "force", "touches"), [(5, 0.6, True), (7, 0.6, False), (5, 0.4, False)])
def test_a_pad_that_measures_a_force_touches_whatever_the_gap(gap, force, touches):
    """5 mm off, by an object or a pad that is described wrongly; a pad 7 mm off presses on something else."""
    model, state = ball_beside("index_3", 1e-3 * gap, 0.01)
    measured = torch.tensor([force * (pad.name == "index") for pad in model.hand.pads], dtype=F64)
    with pytest.raises(NoContactError):
        model.contacts(state)
    for found in (model.contacts, model.touching):
        if touches:
            assert found(state, measured).finger == ("index",)
            assert "index" not in {near.pad for near in found(state, measured).near_misses}
            assert found(state, measured).gap.tolist() == pytest.approx([1e-3 * gap], abs=3e-4)
        else:
            with pytest.raises(NoContactError):
                found(state, measured)


def test_the_name_of_the_actuator_that_cannot_move(toy):
    J_a = toy.model.hand.actuation_jacobian
    doubled = np.concatenate([J_a, J_a[:1]])
    actuators = tuple(
        dataclasses.replace(a, name=n)
        for a, n in zip((*toy.model.hand.actuators, toy.model.hand.actuators[0]), "pqrs", strict=True)
    )
    for on_unstable in ("raise", "flag"):
        model = changed(
            toy.model, options={"on_unstable": on_unstable}, actuation_jacobian=doubled, actuators=actuators
        )
        with pytest.raises(SingularGraspError, match=r"actuator '[ps]' cannot move alone"):
            model.linearize(toy.state)


@pytest.mark.parametrize("toy", [three_finger, soft_two_finger])
def test_margins_after_an_increment_follow_the_sensitivities_and_the_cone(toy):
    toy = toy()
    lin = toy.model.linearize(toy.state, forces=toy.forces())
    da = torch.linspace(-1.0, 1.0, lin.manipulation_jacobian.shape[-1], dtype=F64)
    assert torch.allclose(lin.margins_after(0 * da), lin.margins, atol=1e-12)
    h = 1e-6
    after, before = lin.forces_after(h * da), lin.forces_after(-h * da)
    slope = (after.normal - before.normal) / (2 * h)
    assert torch.allclose(slope, lin.normal_force_sensitivity @ da, rtol=1e-6, atol=1e-6)
    many = lin.forces_after(torch.stack([0 * da, h * da]))
    assert torch.allclose(many.margin[1], after.margin)
    assert many.margin.shape == (2, *after.margin.shape)


def test_increments_that_are_no_increments(toy):
    lin = toy.model.linearize(toy.state)
    for call in (lin.step, lin.margins_after, lin.forces_after):
        with pytest.raises(ShapeError, match="delta_a"):
            call(torch.zeros(4, dtype=F64))
        with pytest.raises(NonFiniteError, match="delta_a"):
            call(torch.full((3,), float("nan"), dtype=F64))


def test_a_batch_is_judged_by_its_worst_state(toy):
    far = dataclasses.replace(toy.state, q=toy.state.q + 2.0)  # from equilibrium
    model = changed(toy.model, options={"on_unstable": "flag"})
    lin = model.linearize(batch_of(toy.state, far), stacked(toy.contacts, toy.contacts))
    doubt = next(d for d in lin.doubts if d.kind is ModelStatus.UNEXPLAINED_TORQUE)
    assert doubt.value == pytest.approx(float(lin.forces.residual.norm(dim=-1).max()))


def test_forces_of_a_solver_that_failed_are_unknown(toy):
    failed = dataclasses.replace(toy.forces(), violation=torch.full((), torch.nan))
    message = _of_missing_forces(failed, reused=False).message
    assert "nan" not in message
    assert "the contact forces are unknown: the step leaves out their stiffness" in message
