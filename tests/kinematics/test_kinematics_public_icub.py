"""The iCub's hand as its public URDF has it, cut out of a robot, beside the one of this package (iKin's).

Figures: robotology/icub-models @dca8c618, iCub_manual, iCubGazeboV2_5_visuomanip, r_hand to r_hand_*_tip
(CC BY-SA 4.0), and gazebo-yarp-plugins @f837061b, ControlBoardDriverCoupling.cpp, for what the motors move.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from made_hands import write_hand
from mk3 import distal_angle

from torch_ekm.description import HandDescription, load_hand
from torch_ekm.kinematics import ActuationMap, HandKinematics

FINGERS = ("thumb", "index", "middle", "ring", "little")
HAND_FRAME = (-0.0576542978, -0.0055568, 0.0136938323), (-1.57079632679, -0.261799319827, 3.14159265359)
# origin [m] and rpy [rad] in r_hand of the joint that spreads a finger or opposes the thumb, ...
BASES = {
    "thumb": ((-0.0318492128, -0.0040568, 0.0192026964), (0.0880846384, -1.3239695221, 2.9758438427)),
    "index": ((-0.0525584344, 0.0051432, 0.0394733411), (1.4815961475, -2.8085129301, 0.0065938571)),
    "middle": ((-0.057540451, 0.0060432, 0.0237779753), (1.5707963268, -2.8797933338, 0.0)),
    "ring": ((-0.0606910842, 0.0054432, 0.0086582262), (-1.5479654094, -0.1543430696, 3.0537749903)),
    "little": ((-0.0636290045, 0.0044432, -0.0101109273), (-1.5479654094, -0.1543430696, 3.0537749903)),
}
# ... from there on the next joint's origin, its turn about x, and the lengths of two phalanges [m] ...
CHAINS = {
    "thumb": ((0.0211, 0.0049, 0.0), -1, 0.026, 0.022),
    "index": ((0.0148, 0.00175, 0.0), 1, 0.0259, 0.022),
    "middle": ((0.0153, 0.0022, 0.0), 1, 0.0258, 0.024),
    "ring": ((0.0148, 0.00175, 0.0), 1, 0.0259, 0.022),
    "little": ((0.0148, -0.00175, 0.0), 1, 0.0219, 0.019),
}
TIP = 0.0168  # ... and of the last one to the frame in the fingertip
LIMITS = {
    "thumb_0": (0, 90),
    "index_0": (-20, 0),
    "middle_0": (0, 0),
    "ring_0": (0, 20),
    "little_0": (0, 20),
}  # [deg]
# largest distance between both models' fingertips over all angles [mm], rounded up to 0.1
APART = {"thumb": 4.8, "index": 3.6, "middle": 2.9, "ring": 11.4, "little": 10.7}


def public_hand(folder: Path) -> HandDescription:
    """The same figures behind an arm's joint, with motors and couplings that both models share."""

    def joint(name: str, parent: str, xyz: tuple[float, ...], rpy: tuple[float, ...] = (0, 0, 0)) -> str:
        low, high = np.radians(LIMITS.get(name, (0, 90)))
        ends = f'<parent link="{parent}"/><child link="{name}"/>'
        limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
        at = f'<origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>'
        turning = f'<joint name="{name}" type="revolute">{ends}{at}<axis xyz="0 0 1"/>{limit}</joint>'
        return turning + f'<link name="{name}"/>'

    parts = ['<robot name="icub"><link name="arm"/>', joint("r_hand", "arm", (0.3, 0.2, 0.1), (1, 2, 3))]
    fixed = '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{0}"/>'
    fixed += '<origin xyz="{2}" rpy="{3}"/></joint>'
    place = (" ".join(map(str, part)) for part in HAND_FRAME)
    parts += ['<link name="hand"/>', fixed.format("hand", "r_hand", *place)]
    for finger in FINGERS:
        knuckle, turn, second, third = CHAINS[finger]
        parts.append(joint(f"{finger}_0", "r_hand", *BASES[finger]))
        parts.append(joint(f"{finger}_1", f"{finger}_0", knuckle, (turn * np.pi / 2, 0, 0)))
        parts.append(joint(f"{finger}_2", f"{finger}_1", (second, 0, 0)))
        parts.append(joint(f"{finger}_3", f"{finger}_2", (third, 0, 0)))
        tip = f"{finger}_tip"
        parts += [f'<link name="{tip}"/>', fixed.format(tip, f"{finger}_3", f"{TIP} 0 0", "0 0 0")]
    (folder / "icub.urdf").write_text("".join(parts) + "</robot>")
    ours = load_hand("icub_right").transmission_path.read_text()
    for old, new in (
        ("{ index_0 = -1.0, ", "{ index_0 = 1.0, "),
        ("1.0, ring_0 = -1.0 }", "1.0, ring_0 = 1.0 }"),
    ):
        assert ours.count(old) == 1
        ours = ours.replace(old, new)  # the index finger's angle counts the other way
    (folder / "icub.transmission.toml").write_text(ours)
    return load_hand(folder / "icub.urdf")


def test_the_public_hand_is_cut_out_and_its_difference_stated(tmp_path: Path) -> None:
    public, ours = public_hand(tmp_path), load_hand("icub_right")
    assert public.joint_names == ours.joint_names
    shares = torch.cartesian_prod(*[torch.linspace(0.0, 1.0, 7, dtype=torch.float64)] * 4).repeat(1, 5)
    q = torch.from_numpy(ours.joint_lower) + shares * torch.from_numpy(ours.joint_upper - ours.joint_lower)
    q = torch.cat([torch.zeros_like(q[:1]), q])  # extended, and all angles of each finger
    theirs = q.clone()
    theirs[:, ours.joint_names.index("index_0")] *= -1  # it counts the other way
    there, here = HandKinematics(public)(theirs), HandKinematics(ours)(q)
    for finger, most in APART.items():
        apart = 1e3 * (there.of(f"{finger}_tip") - here.of(f"{finger}_tip"))[:, :3, 3].norm(dim=1)
        assert most - 0.1 < float(apart.max()) <= most, (finger, float(apart.max()))
    extended = [(there.of(f"{f}_tip") - here.of(f"{f}_tip"))[0, :3, 3].norm().item() for f in FINGERS]
    assert 1e3 * np.array(extended) == pytest.approx([4.45, 3.59, 2.80, 9.74, 9.02], abs=0.005)


def test_both_hands_have_the_public_coupling(tmp_path: Path) -> None:
    """Where the public coupling puts the joints for positions ``a``, the motors are at ``a``."""
    a = np.array([30.0, 40.0, 50.0, 60.0, 20.0, 80.0, 30.0, 70.0, 90.0])
    spread = 20 - a[0] / 3
    q = [a[1], a[2], a[3] / 2, a[3] / 2, -spread, a[4], a[5] / 2, a[5] / 2, 0.0, a[6], a[7] / 2, a[7] / 2]
    q += [spread, *[a[8] / 3] * 3] * 2
    for hand, sign in ((public_hand(tmp_path), 1), (load_hand("icub_right"), -1)):
        posture = torch.from_numpy(np.radians(q))
        posture[hand.joint_names.index("index_0")] *= sign
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
