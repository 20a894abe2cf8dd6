"""The Yale OpenHand T42: two fingers of two joints, one tendon and one servo each, planar.

Everything moves in the plane z = 0 of the frame ``hand`` (x to the right finger, y away from the palm); the
plane is level, so gravity moves nothing. At q = 0 both fingers point along +y; positive
angles flex them towards each other. README.md tells where each figure comes from.
"""

from __future__ import annotations

import math

from _icub import inline
from _writer import Box, Rod, Vector, joint_xml, link_xml, solid_inertia

BASE = 0.026  # m, half the distance of the two base joints
PROXIMAL = 0.0625  # m, joint to joint
BONE = 0.008  # m, half the thickness of the proximal link
PAD_RADIUS = 0.010475  # m, of the arc at the fingertip
PAD_OFFSET = 0.001475  # m, its centre palmar of the joint's line; the flat pad is a tangent of the arc
PAD_FROM, PAD_TO = 0.004, 0.0375  # m along the finger: from where contacts are seen, and the arc's centre
TIP = PAD_TO + PAD_RADIUS  # m
MASS = (0.40, 0.0185, 0.0237)  # kg: palm with servos, proximal, distal
LIMITS = ((-90.0, 82.0), (0.0, 90.0))  # deg: proximal, distal
SPRINGS = (0.2, 0.4)  # N m/rad: proximal, distal
ARM = 8.0 / 10.5  # motor angle per joint angle: pulleys of 8 mm on a spool of 10.5 mm, both joints
SERIES = 13.0  # stiffness of servo and tendon, in units of the proximal spring
PLAY = 0.04  # rad, from one end to the other
FRICTION = 1.16  # pad on object
FINGERS: dict[str, tuple[float, float]] = {
    "left": (-BASE, -1.0),
    "right": (BASE, 1.0),
}  # base x, sign of axis


def urdf_text() -> str:
    palm = Box((0, -0.030, 0), (0.090, 0.040, 0.030))
    parts = [link_xml("hand", solid_inertia(palm, MASS[0]), [palm], "palm")]
    for finger, (x, sign) in FINGERS.items():
        axis: Vector = (0, 0, sign)
        first, second, tip = f"{finger}_0", f"{finger}_1", f"{finger}_tip"
        limits = [(math.radians(low), math.radians(high)) for low, high in LIMITS]
        turn = (0, 0, math.pi / 2)
        parts.append(joint_xml(first, "hand", first, (x, 0, 0), turn, axis, limits[0], 2, 5))
        bone = Rod((0, 0, 0), (PROXIMAL, 0, 0), BONE)
        parts.append(link_xml(first, solid_inertia(bone, MASS[1]), [bone], "bone"))
        parts.append(joint_xml(second, first, second, (PROXIMAL, 0, 0), (0, 0, 0), axis, limits[1], 2, 5))
        pad = Rod((PAD_FROM, sign * PAD_OFFSET, 0), (PAD_TO, sign * PAD_OFFSET, 0), PAD_RADIUS)
        parts.append(link_xml(second, solid_inertia(pad, MASS[2]), [pad], "pad"))
        parts.append(joint_xml(f"{tip}_joint", second, tip, (TIP, 0, 0), (0, 0, 0)))
        parts.append(link_xml(tip, None, []))
    return (
        """<?xml version="1.0"?>
<!-- The Yale OpenHand T42, from published figures: two fingers, four joints, two tendons. Written by
     generate.py. -->
<robot name="yale_t42">
  <material name="palm"><color rgba="0.30 0.33 0.38 1"/></material>
  <material name="bone"><color rgba="0.20 0.36 0.62 1"/></material>
  <material name="pad"><color rgba="0.16 0.17 0.19 1"/></material>
"""
        + "\n".join(parts)
        + "\n</robot>\n"
    )


def transmission_text() -> str:
    out = [
        """# What the URDF of the Yale T42 cannot say. Written by generate.py: change the figures there.

[hand]
name = "yale_t42"
base_link = "hand"
planar_normal = [0.0, 0.0, 1.0]  # everything moves in the plane z = 0
gravity = [0.0, 0.0, 9.81]  # [m/s^2], across the plane: the hand lies

[joints]  # spring [N m/rad], rest angle, Coulomb friction [N m]"""
    ]
    for finger in FINGERS:
        out += [f"{finger}_{k} = {{ spring = {SPRINGS[k]}, rest_deg = 0.0, friction = 0.0 }}" for k in (0, 1)]
    out.append(f"""
# One servo per finger winds one tendon over both joints: a = {ARM:.4f} (q_0 + q_1).""")
    most = math.degrees(ARM * math.radians(LIMITS[0][1] + LIMITS[1][1]))
    for finger in FINGERS:
        arms = {f"{finger}_{k}": round(ARM, 6) for k in (0, 1)}
        out.append(f"""
[[actuators]]
name = "{finger}"
range_deg = [{math.degrees(ARM * math.radians(LIMITS[0][0])):.1f}, {most + 60:.1f}]
moment_arms = {inline(arms)}
tendon = true
stiffness = {round(SERIES * SPRINGS[0], 6)}
backlash = {PLAY}""")
    out.append("\n# The flat of the distal link and the arc at its end: a capsule exactly [m, link frame].")
    for finger, (_, sign) in FINGERS.items():
        out.append(f"""
[[pads]]
name = "{finger}"
link = "{finger}_1"
start = [{PAD_FROM}, {sign * PAD_OFFSET}, 0.0]
end = [{PAD_TO}, {sign * PAD_OFFSET}, 0.0]
radius = {PAD_RADIUS}
direction = [0.0, {sign}, 0.0]""")
    return "\n".join(out) + "\n"
