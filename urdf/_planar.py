"""A planar hand of two fingers with two joints each and one tendon per finger: small enough to check by hand.

Everything moves in the plane z = 0 of the frame ``hand`` (x to the right finger, y away from the palm).
At q = 0 both fingers point along +y; positive angles flex them towards each other. Round figures, chosen.
"""

from __future__ import annotations

from _icub import inline
from _writer import Box, Rod, Vector, joint_xml, link_xml, solid_inertia

BASE = 0.03  # m, half the distance of the two finger bases
PROXIMAL, DISTAL = 0.04, 0.03  # m, lengths of the phalanges
RADIUS = 0.006  # m
MASS = (0.10, 0.010, 0.008)  # kg: palm, proximal, distal
LIMITS = ((-0.5, 1.5), (0.0, 1.5))  # rad: proximal, distal
SPRINGS = (0.2, 0.1)  # N m/rad
ARMS = (1.0, 0.8)  # pulley radius of the distal joint is 0.8 of the motor's
FINGERS: dict[str, tuple[float, float]] = {
    "left": (-BASE, -1.0),
    "right": (BASE, 1.0),
}  # base x, sign of axis


def urdf_text() -> str:
    palm = Box((0, -0.01, 0), (0.08, 0.02, 0.02))
    parts = [link_xml("hand", solid_inertia(palm, MASS[0]), [palm], "palm")]
    for finger, (x, sign) in FINGERS.items():
        axis: Vector = (0, 0, sign)
        quarter = 1.5707963267948966
        parts.append(
            joint_xml(f"{finger}_0", "hand", f"{finger}_0", (x, 0, 0), (0, 0, quarter), axis, LIMITS[0], 2, 5)
        )
        rod = Rod((0, 0, 0), (PROXIMAL, 0, 0), RADIUS)
        parts.append(link_xml(f"{finger}_0", solid_inertia(rod, MASS[1]), [rod], "bone"))
        origin: Vector = (PROXIMAL, 0, 0)
        parts.append(
            joint_xml(f"{finger}_1", f"{finger}_0", f"{finger}_1", origin, (0, 0, 0), axis, LIMITS[1], 2, 5)
        )
        rod = Rod((0, 0, 0), (DISTAL, 0, 0), RADIUS)
        parts.append(link_xml(f"{finger}_1", solid_inertia(rod, MASS[2]), [rod], "pad"))
        tip = f"{finger}_tip"
        parts += [
            joint_xml(f"{tip}_joint", f"{finger}_1", tip, (DISTAL, 0, 0), (0, 0, 0)),
            link_xml(tip, None, []),
        ]
    return (
        """<?xml version="1.0"?>
<!-- A planar hand: two fingers, four joints, two tendons. Written by generate.py. -->
<robot name="planar_two_finger">
  <material name="palm"><color rgba="0.55 0.57 0.60 1"/></material>
  <material name="bone"><color rgba="0.86 0.86 0.84 1"/></material>
  <material name="pad"><color rgba="0.20 0.21 0.23 1"/></material>
"""
        + "\n".join(parts)
        + "\n</robot>\n"
    )


def transmission_text() -> str:
    out = [
        """# What the URDF of the planar hand cannot say. Written by generate.py: change the figures there.

[hand]
name = "planar_two_finger"
base_link = "hand"
planar_normal = [0.0, 0.0, 1.0]  # everything moves in the plane z = 0
gravity = [0.0, 0.0, 9.81]  # [m/s^2]

[joints]  # spring [N m/rad], rest angle, Coulomb friction [N m]"""
    ]
    for finger in FINGERS:
        out += [f"{finger}_{k} = {{ spring = {SPRINGS[k]}, rest_deg = 0.0, friction = 0.0 }}" for k in (0, 1)]
    out.append("\n# One tendon per finger pulls on both joints: a = q_0 + 0.8 q_1.")
    for finger in FINGERS:
        arms = {f"{finger}_{k}": ARMS[k] for k in (0, 1)}
        out.append(f"""
[[actuators]]
name = "{finger}"
range_deg = [0.0, 150.0]
moment_arms = {inline(arms)}
tendon = true
stiffness = 10.0""")
    out.append("\n# Balls at the fingertips (a capsule whose ends coincide) [m, link frame].")
    for finger, (_, sign) in FINGERS.items():
        out.append(f"""
[[pads]]
name = "{finger}"
link = "{finger}_1"
start = [{DISTAL}, 0.0, 0.0]
radius = {RADIUS}
direction = [0.0, {sign}, 0.0]""")
    return "\n".join(out) + "\n"
