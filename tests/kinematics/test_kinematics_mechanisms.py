"""Where free mechanisms rest: as MuJoCo has it, under tendons, springs, equalities and stops."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from made_hands import write_hand
from scipy.interpolate import CubicSpline

from torch_ekm.description import HandDescription, load_hand, write_transmission
from torch_ekm.description.hand import ArmFunction, Lengths
from torch_ekm.kinematics import ActuationMap

_HEAD = '<mujoco model="{name}"><compiler angle="radian"/><option gravity="0 0 0"/>'
_PALM = '<geom type="box" size=".02 .02 .01"/>'


def _link(name: str, at: float, inside: str = "", joint: str = "", x: float = 0.0) -> str:
    """A link that turns about y, 40 mm long, with what it carries; joint: more attributes of its joint."""
    return (
        f'<body name="{name}" pos="{x} 0 {at}"><joint name="{name}" axis="0 1 0" range="-0.2 1.6" {joint}/>'
        f'<site name="{name}_low" pos=".009 0 .008"/><site name="{name}_high" pos=".007 0 .03"/>'
        f'<geom type="capsule" size=".005" fromto="0 0 .01 0 0 .035"/>{inside}</body>'
    )


def _finger(near: str = "", far: str = "", prefix: str = "", x: float = 0.0) -> str:
    return _link(f"{prefix}near", 0.02, _link(f"{prefix}far", 0.04, joint=far), near, x)


def _hand(name: str, bodies: str, tendons: str = "", actuators: str = "", equality: str = "") -> str:
    palm = f'<body name="palm">{_PALM}<site name="palm_site" pos=".01 0 .012"/>{bodies}</body>'
    rest = f"<tendon>{tendons}</tendon><equality>{equality}</equality><actuator>{actuators}</actuator>"
    return f"{_HEAD.format(name=name)}<worldbody>{palm}</worldbody>{rest}</mujoco>"


def _fixed(name: str, arms: dict[str, float], more: str = "") -> str:
    joints = "".join(f'<joint joint="{joint}" coef="{arm}"/>' for joint, arm in arms.items())
    return f'<fixed name="{name}" {more}>{joints}</fixed>'


def _routed(name: str, sites: tuple[str, ...], more: str = "") -> str:
    return f'<spatial name="{name}" {more}>' + "".join(f'<site site="{s}"/>' for s in sites) + "</spatial>"


def _pull(tendon: str, kp: float, span: str, more: str = 'forcerange="0 1e6"', name: str = "motor") -> str:
    return f'<position name="{name}" tendon="{tendon}" kp="{kp}" ctrlrange="{span}" {more}/>'


def _turn(joint: str, kp: float, most: float, name: str = "motor") -> str:
    return f'<position name="{name}" joint="{joint}" kp="{kp}" ctrlrange="0 {most}"/>'


_WAY = ("palm_site", "near_low", "near_high", "far_low", "far_high")
_ARMS, _RATIOS = {"near": 0.01, "far": 0.008}, {"near": 1.0, "far": 0.8}
_FLEXOR, _BY_RATIOS = _fixed("flexor", _ARMS), _fixed("flexor", _RATIOS)
_STIFF, _SHORTENS = _pull("flexor", 1e4, "0 0.025"), 'forcerange="-1e6 0"'
_COUPLER = (
    '<body name="coupler" pos="0 0 .04"><joint name="coupler" axis="0 1 0" range="-1.6 1.6"/>'
    '<geom type="capsule" size=".004" fromto="0 0 .005 0 0 .025"/></body>'
)
_TWO_FINGERS = _finger('stiffness=".05"', 'stiffness=".04"') + _finger(
    'stiffness=".03"', 'stiffness=".06"', "b_", 0.03
)

# bodies; tendons, actuators, equality
_MADE: dict[str, tuple[str, ...]] = {
    "tendon_spring": (
        _finger('stiffness=".035"'),
        _FLEXOR + _fixed("back", {"far": 0.01}, 'stiffness="350" springlength="0"'),
        _STIFF,
    ),
    "slack_spring": (
        _finger('stiffness=".02"', 'stiffness=".03"'),
        _FLEXOR + _fixed("back", _ARMS, 'stiffness="900" springlength="0 .006"'),
        _STIFF,
    ),
    "routed_flexor": (
        _finger('stiffness=".04"', 'stiffness=".03"'),
        _routed("flexor", _WAY),
        _pull("flexor", 8000, ".05 .1", _SHORTENS),
    ),
    "routed_spring": (
        _finger('stiffness=".05"', 'stiffness=".05"'),
        _FLEXOR + _routed("back", _WAY, 'stiffness="300" springlength=".07"'),
        _STIFF,
    ),
    "stops": (_finger('stiffness=".01"', 'stiffness=".05"'), _BY_RATIOS, _pull("flexor", 40, "0 2.6")),
    "preloaded": (
        _finger('stiffness=".1" springref="-1"', 'stiffness=".05"'),
        _BY_RATIOS,
        _pull("flexor", 40, "0 2.0"),
    ),
    "servos": (_finger(), "", _turn("near", 8, 1.5, "m_near") + _turn("far", 3, 1.5, "m_far")),
    "coupled": (
        _finger('stiffness=".1"', 'stiffness=".05" springref=".3"'), "", _turn("near", 5, 1.5),
        '<joint joint1="far" joint2="near" polycoef="0 .7 0 0 0"/>',
    ),
    "curved": (
        _finger('stiffness=".1"', 'stiffness=".05"'), "", _turn("near", 5, 1.5),
        '<joint joint1="far" joint2="near" polycoef=".05 .6 .3 -.1 0"/>',
    ),
    "four_bar": (
        _link("crank", 0.02, _COUPLER, x=0.03) + _link("rocker", 0.02, joint='stiffness=".05"', x=0.015),
        "", _turn("crank", 4, 1), '<connect body1="coupler" body2="rocker" anchor="0 0 .03"/>',
    ),
    "tied_tendons": (
        _TWO_FINGERS,
        _fixed("one", _ARMS) + _fixed("other", {"b_near": 0.01, "b_far": 0.006}),
        _pull("one", 6000, "0 0.02", ""),
        '<tendon tendon1="one" tendon2="other" polycoef="0 1 0 0 0"/>',
    ),
    "two_motors": (
        _finger('stiffness=".04"', 'stiffness=".02"'),
        _FLEXOR + _routed("extensor", _WAY) + _fixed("stay", {"far": 0.01}, 'stiffness="200"'),
        _pull("flexor", 9000, "0 .02", name="flex") + _pull("extensor", 4000, ".05 .1", _SHORTENS, "hold"),
    ),
}  # fmt: skip

MECHANISMS = {name: _hand(name, *parts) for name, parts in _MADE.items()}
"""Name -> MJCF, twelve of them."""

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
