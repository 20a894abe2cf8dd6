"""The iCub hand (v1 and v2): every figure, and the URDF and transmission texts made of them.

Sources of each table are named above it; urdf/README.md lists them with their licences.
Units: m, rad, kg, N m; degrees where the name says so.
"""

from __future__ import annotations

import math

import numpy as np
from _writer import (
    Box,
    Inertia,
    Rod,
    Solid,
    Vector,
    joint_xml,
    link_xml,
    mirrored,
    mirrored_inertia,
    number,
    solid_inertia,
)
from trimesh.transformations import compose_matrix

HALF_TURN = math.pi / 2

# Origin xyz [m] and rpy [rad] of each joint in its parent link, axis, limits [deg]. iKin's chain
# (icub-main, iKinFwd.cpp, iCubFinger::allocate, thumb version b) with its H0 made orthonormal and
# the abduction angle counted from the adducted pose; middle_0 is the locked joint of the real hand,
# 15.3 mm behind the knuckle. Limits: robots-configuration (thumb_0 10..90) and iKin.
JOINTS: dict[str, tuple[Vector, Vector, Vector, tuple[float, float]]] = {
    "thumb_0": ((-0.024029759, -0.01193433, -0.00168926), (1.496023075, -0.003999895, -1.07188182),
                (0, 0, 1), (10, 90)),
    "thumb_1": ((0.021, 0.0056, 0), (-HALF_TURN, 0, 0), (0, 0, 1), (0, 90)),
    "thumb_2": ((0.026, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "thumb_3": ((0.022, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "index_0": ((0.00245549, -0.025320433, -0.010973325), (-0.086777413, -0.009240104, -0.105812861),
                (0, 0, -1), (0, 20)),
    "index_1": ((0.0148, 0, 0), (HALF_TURN, 0, 0), (0, 0, 1), (0, 90)),
    "index_2": ((0.0259, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "index_3": ((0.022, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "middle_0": ((0.0025, -0.00830233, -0.0118), (0, 0, 0), (0, 0, 1), (0, 0)),
    "middle_1": ((0.0153, 0, 0), (HALF_TURN, 0, 0), (0, 0, 1), (0, 90)),
    "middle_2": ((0.0285, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "middle_3": ((0.024, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "ring_0": ((0.00156923, 0.007158757, -0.011458935), (0.087253008, -0.001687139, 0.019114917),
               (0, 0, 1), (0, 20)),
    "ring_1": ((0.0148, 0, 0), (HALF_TURN, 0, 0), (0, 0, 1), (0, 90)),
    "ring_2": ((0.0259, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "ring_3": ((0.022, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "little_0": ((-0.00042147, 0.0232755, -0.00956329), (0.087253008, -0.001687139, 0.019114917),
                 (0, 0, 1), (0, 20)),
    "little_1": ((0.0148, 0, 0), (HALF_TURN, 0, 0), (0, 0, 1), (0, 90)),
    "little_2": ((0.0219, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
    "little_3": ((0.019, 0, 0), (0, 0, 0), (0, 0, 1), (0, 90)),
}  # fmt: skip
FINGERS = ("thumb", "index", "middle", "ring", "little")
TIP: tuple[Vector, Vector] = ((0.0168, 0, 0), (-HALF_TURN, 0, 0))  # iKin's last DH frame

# Mass [kg], centre of mass [m], principal inertias about it [kg m^2] (off-diagonal terms not derived).
# Whole hand 0.2483 kg: icub-models, iCubGenova02, r_hand (CAD of v2). Shares of the links derived:
# uniform density 2277 kg/m^3 over the convex hulls of the public meshes.
INERTIAS: dict[str, tuple[float, Vector, Vector]] = {
    "thumb_0": (0.00788, (0.01041, 0.00258, 0.00016), (1.846e-07, 5.399e-07, 5.54e-07)),
    "thumb_1": (0.00831, (0.01309, -0.00018, 9e-05), (1.571e-07, 6.903e-07, 6.835e-07)),
    "thumb_2": (0.00714, (0.01139, -0.00023, 6e-05), (1.315e-07, 4.803e-07, 4.737e-07)),
    "thumb_3": (0.00727, (0.01052, -0.00051, 0.00017), (1.505e-07, 4.211e-07, 4.113e-07)),
    "index_0": (0.00533, (0.00725, 0.00141, -0.0004), (9.15e-08, 2.453e-07, 2.476e-07)),
    "index_1": (0.00817, (0.01325, -0.00018, 5e-05), (1.532e-07, 6.655e-07, 6.591e-07)),
    "index_2": (0.00714, (0.01139, -0.00023, 6e-05), (1.314e-07, 4.798e-07, 4.73e-07)),
    "index_3": (0.00735, (0.01055, -0.00057, 0.00017), (1.541e-07, 4.257e-07, 4.17e-07)),
    "middle_0": (0.00588, (0.00675, 0.00126, -0.00025), (1.031e-07, 3.075e-07, 3.127e-07)),
    "middle_1": (0.009, (0.0146, -0.00018, 4e-05), (1.703e-07, 8.574e-07, 8.518e-07)),
    "middle_2": (0.00768, (0.01243, -0.00023, 4e-05), (1.422e-07, 5.804e-07, 5.73e-07)),
    "middle_3": (0.00727, (0.01051, -0.00051, 0.00017), (1.505e-07, 4.204e-07, 4.107e-07)),
    "ring_0": (0.00518, (0.00703, 0.0015, -0.00042), (8.851e-08, 2.324e-07, 2.34e-07)),
    "ring_1": (0.00829, (0.01316, -0.0002, 5e-05), (1.564e-07, 6.851e-07, 6.8e-07)),
    "ring_2": (0.00714, (0.01139, -0.00023, 6e-05), (1.316e-07, 4.806e-07, 4.741e-07)),
    "ring_3": (0.00736, (0.01056, -0.00057, 0.00017), (1.542e-07, 4.261e-07, 4.175e-07)),
    "little_0": (0.00512, (0.00711, -0.00125, 8e-05), (8.587e-08, 2.282e-07, 2.298e-07)),
    "little_1": (0.00714, (0.01124, -0.00025, 6e-05), (1.322e-07, 4.708e-07, 4.654e-07)),
    "little_2": (0.00632, (0.0099, -0.00022, 6e-05), (1.151e-07, 3.512e-07, 3.458e-07)),
    "little_3": (0.00736, (0.01056, -0.00057, 0.00017), (1.543e-07, 4.264e-07, 4.176e-07)),
}
PALM_MASS, PALM_COM = 0.1059, (-0.0232, -0.0007, -0.0108)  # derived from the same centre of mass
PALM_MIN, PALM_MAX = (-0.0721, -0.0350, -0.0267), (0.0067, 0.0320, 0.0030)  # bounding box, measured

# Phalanges: capsules of radius 6.3 mm (12..13.3 mm thick, 12.9..13.1 mm wide, measured), from and to
# the measured ends [m] along x. The thumb's first link is bent: its axis is given by its ends.
PHALANX_RADIUS = 0.0063
PHALANX_X: dict[str, tuple[float, float]] = {
    "thumb_1": (-0.0038, 0.0306), "thumb_2": (-0.0030, 0.0268),
    "index_0": (-0.0047, 0.0195), "index_1": (-0.0031, 0.0309), "index_2": (-0.0030, 0.0269),
    "middle_0": (-0.0052, 0.0199), "middle_1": (-0.0031, 0.0336), "middle_2": (-0.0030, 0.0289),
    "ring_0": (-0.0048, 0.0195), "ring_1": (-0.0031, 0.0310), "ring_2": (-0.0030, 0.0266),
    "little_0": (-0.0048, 0.0195), "little_1": (-0.0033, 0.0267), "little_2": (-0.0031, 0.0237),
}  # fmt: skip
THUMB_0_AXIS = ((0.0017, 0.0015, 0.0), (0.0195, 0.0039, 0.0))

# Fingertips: all five alike, 24.36 mm long, 13 mm thick, 14 mm wide (measured on the public meshes):
# a capsule that ends at the same point. The same capsule is the contact pad.
PAD_RADIUS, PAD_START, PAD_END = 0.0065, (0.0035, 0.0, 0.0), (0.01786, 0.0, 0.0)

# Our choices where nothing is published; the reasons stand in the transmission file's comments.
JOINT_SPRING = 0.15  # N m/rad
JOINT_SPRING_PHYSICAL = 3.5e-3  # N m/rad
LOOPED_SPRING = 0.01  # N m/rad
ACTUATOR_STIFFNESS = 4.0  # N m/rad
JOINT_FRICTION = 0.01  # N m
PAD_TORSION = 0.0  # m
EFFORT, VELOCITY = 2.0, 2.0  # N m, rad/s

SPRUNG = ("thumb_2", "thumb_3", "index_2", "index_3", "middle_2", "middle_3",
          "ring_1", "ring_2", "ring_3", "little_1", "little_2", "little_3")  # fmt: skip

# MAIS boards: channel = place in this list (icub-firmware, EOappEncodersReader.c).
HALL = [f"{finger}_{k}" for finger in FINGERS for k in (1, 2, 3)]

RIGHT, MIRROR_Y, MIRROR_Z = (1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0)


def _signs(link: str, left: bool) -> Vector:
    """How the left hand's link frame is mirrored.

    The palm and the four abduction links keep x and z and turn y over; the thumb and the phalanges
    keep x (along the bone) and y (palmar) and turn z over, so that flexion stays positive about +z.
    """
    if not left:
        return RIGHT
    palmar_y = link.startswith("thumb_") or link[-1] in "123"
    return MIRROR_Z if palmar_y and not link.endswith("tip") else MIRROR_Y


def _joint_frame(xyz: Vector, rpy: Vector, parent: Vector, child: Vector) -> tuple[Vector, Vector]:
    """``p' = D_parent p``, ``R' = D_parent R D_child`` with diagonal reflections D."""
    T = compose_matrix(translate=xyz, angles=rpy)
    R = np.array(parent)[:, None] * T[:3, :3] * np.array(child)
    p = np.array(parent) * T[:3, 3]
    turn = (math.atan2(R[2, 1], R[2, 2]), -math.asin(np.clip(R[2, 0], -1, 1)), math.atan2(R[1, 0], R[0, 0]))
    return (p[0], p[1], p[2]), turn


def _solids(link: str) -> list[Solid]:
    if link.endswith("_3"):
        return [Rod(PAD_START, PAD_END, PAD_RADIUS)]
    if link == "thumb_0":
        return [Rod(*THUMB_0_AXIS, PHALANX_RADIUS)]
    low, high = PHALANX_X[link]
    return [Rod((low + PHALANX_RADIUS, 0, 0), (high - PHALANX_RADIUS, 0, 0), PHALANX_RADIUS)]


def urdf_text(left: bool) -> str:
    side = "left" if left else "right"
    palm = Box(
        tuple((a + b) / 2 for a, b in zip(PALM_MIN, PALM_MAX, strict=True)),  # type: ignore[arg-type]
        tuple(b - a for a, b in zip(PALM_MIN, PALM_MAX, strict=True)),  # type: ignore[arg-type]
    )
    palm_inertia = Inertia(PALM_MASS, PALM_COM, solid_inertia(palm, PALM_MASS).tensor)
    signs = _signs("hand", left)
    parts = [link_xml("hand", mirrored_inertia(palm_inertia, signs), [mirrored(palm, signs)], "palm")]
    for finger in FINGERS:
        parent = "hand"
        for name in (f"{finger}_{k}" for k in range(4)):
            xyz, rpy, axis, limits_deg = JOINTS[name]
            signs = _signs(name, left)
            mass, com, moments = INERTIAS[name]
            inertia = mirrored_inertia(Inertia(mass, com, np.diag(moments)), signs)
            solids = [mirrored(solid, signs) for solid in _solids(name)]
            frame = _joint_frame(xyz, rpy, _signs(parent, left), signs)
            # D exp([z] q) D = exp([det(D) D z] q): axes are axial vectors
            turned: Vector = (
                tuple(np.prod(signs) * s * a for s, a in zip(signs, axis, strict=True)) if left else axis
            )  # type: ignore[assignment]
            lower, upper = (math.radians(limit) for limit in limits_deg)
            parts.append(joint_xml(name, parent, name, *frame, turned, (lower, upper), EFFORT, VELOCITY))
            parts.append(link_xml(name, inertia, solids, "pad" if name.endswith("_3") else "bone"))
            parent = name
        tip = f"{finger}_tip"
        frame = _joint_frame(*TIP, _signs(parent, left), _signs(tip, left))
        parts += [joint_xml(f"{tip}_joint", parent, tip, *frame), link_xml(tip, None, [])]
    towards = "away from" if left else "towards"
    head = f"""<?xml version="1.0"?>
<!-- The iCub {side} hand (v1 and v2). Written by generate.py: change the figures there, not here.
     Sources of every figure: README.md in this folder.
     hand: x along the extended middle finger, y {towards} the little finger, z out of the palm [m, rad]. -->
<robot name="icub_{side}_hand">
  <material name="palm"><color rgba="0.55 0.57 0.60 1"/></material>
  <material name="bone"><color rgba="0.86 0.86 0.84 1"/></material>
  <material name="pad"><color rgba="0.20 0.21 0.23 1"/></material>
"""
    return head + "\n".join(parts) + "\n</robot>\n"


#: Abduction, ring and little finger shape the hand before a pinch.
POSTURE = ("hand_finger", "pinky")
# name, range [deg], offset [deg], tendon, moment arms, remark
ACTUATORS: list[tuple[str, tuple[int, int], int, bool, dict[str, float], str]] = [
    ("hand_finger", (0, 60), 60, False, {"index_0": -1, "ring_0": -1, "little_0": -1},
     "one looped cable through three base pulleys; 60 deg: fingers together, 0: spread"),
    ("thumb_oppose", (10, 90), 0, False, {"thumb_0": 1}, "looped cable"),
    ("thumb_proximal", (0, 90), 0, False, {"thumb_1": 1}, "looped tendon"),
    ("thumb_distal", (0, 180), 0, True, {"thumb_2": 1, "thumb_3": 1}, "one tendon over two sprung joints"),
    ("index_proximal", (0, 90), 0, False, {"index_1": 1}, "looped tendon"),
    ("index_distal", (0, 180), 0, True, {"index_2": 1, "index_3": 1}, "one tendon over two sprung joints"),
    ("middle_proximal", (0, 90), 0, False, {"middle_1": 1}, "looped tendon"),
    ("middle_distal", (0, 180), 0, True, {"middle_2": 1, "middle_3": 1}, "one tendon over two sprung joints"),
    ("pinky", (0, 270), 0, True, {f"{f}_{k}": 0.5 for f in ("ring", "little") for k in (1, 2, 3)},
     "two tendons of equal travel on one capstan, six sprung joints"),
]  # fmt: skip

COUPLINGS: list[tuple[str, dict[str, float]]] = [
    ("the middle finger does not spread", {"middle_0": 1}),
    ("index and ring spread by the same angle", {"index_0": 1, "ring_0": -1}),
    ("ring and little spread by the same angle", {"ring_0": 1, "little_0": -1}),
    ("ring and little tendons travel alike", {"ring_1": 1, "ring_2": 1, "ring_3": 1,
                                              "little_1": -1, "little_2": -1, "little_3": -1}),
]  # fmt: skip


def inline(table: dict[str, float]) -> str:
    return "{ " + ", ".join(f"{key} = {float(value)}" for key, value in table.items()) + " }"


def transmission_text(left: bool) -> str:
    side = "left" if left else "right"
    out = [
        f"""\
# What the URDF of the iCub {side} hand cannot say. Written by generate.py: change the figures there.
# Angles of actuators are those of the robot's control boards (its axes 7 to 15); a = offset + J_a q.

[hand]
name = "icub_{side}"
base_link = "hand"
gravity = [0.0, 0.0, 9.81]  # [m/s^2]: the palm faces down

# Springs [N m/rad] and their rest angles, Coulomb friction [N m] of every joint.
#
# Return springs of the distal joints. The only published part number (RT017-180-156, read as a stock
# torsion spring) suggests {JOINT_SPRING_PHYSICAL} N m/rad, range 2e-3 to 5e-3. With that alone no pinch
# can be modelled: both distal joints share one tendon of equal moment arms, so the springs carry the whole
# difference of their contact torques, about 4 N x 22 mm = 0.09 N m, for which 3.5e-3 N m/rad would have
# to yield by 25 rad. Real fingers then lie against their stops or are held by friction.
# {JOINT_SPRING} N m/rad stands for spring, skin, cable sheath and friction together: a pinch of 3 to 5 N
# makes the two joints differ by 25 to 42 deg. Looped joints have no return spring: {LOOPED_SPRING} N m/rad
# keeps the stiffness matrix invertible and is nothing beside the servo. Rest at q = 0: springs open the hand.
# Friction is an estimate: a tenth of the torque of 4 N at a fingertip.
[joints]"""
    ]
    for name in JOINTS:
        spring = JOINT_SPRING if name in SPRUNG else LOOPED_SPRING
        entry = f"{name:<8} = {{ spring = {spring}, rest_deg = 0.0, friction = {JOINT_FRICTION} }}"
        out.append(entry)
    out.append(f"""
# Unit moment arms: the boards close their position loops on sensors at the joints (on the sum of two
# for a distal axis, of three for the little finger), so a = sum of joint angles whatever the pulley radii.
# tendon = true: it can only pull, springs open the joint. stiffness [N m/rad]: tendon and servo in
# series, {ACTUATOR_STIFFNESS} is an estimate of what the position controller shows at the joint.""")
    for name, (lower, upper), offset, tendon, arms, remark in ACTUATORS:
        posture = "\nposture = true" if name in POSTURE else ""
        out.append(f"""
[[actuators]]  # {remark}
name = "{name}"
range_deg = [{float(lower)}, {float(upper)}]
offset_deg = {float(offset)}
moment_arms = {inline(arms)}
tendon = {str(tendon).lower()}
stiffness = {ACTUATOR_STIFFNESS}{posture}""")
    out.append("\n# Rigid couplings: sum of weight x joint angle stays what it is at rest.")
    out += [f'\n[[couplings]]\nname = "{name}"\njoints = {inline(arms)}' for name, arms in COUPLINGS]
    out.append(f"""
# Fingertips: capsules of {PAD_RADIUS * 1e3:g} mm, the same as the URDF's collision shapes [m, link frame].
# direction: the palmar side. torsional_friction [m]: {PAD_TORSION:g} is a point contact with friction, as
# a simulator's is; a soft pad has 2 to 4 mm.""")
    for finger in FINGERS:
        out.append(f"""
[[pads]]
name = "{finger}"
link = "{finger}_3"
start = [{", ".join(number(v) if v else "0.0" for v in PAD_START)}]
end = [{", ".join(number(v) if v else "0.0" for v in PAD_END)}]
radius = {PAD_RADIUS}
direction = [0.0, 1.0, 0.0]
torsional_friction = {PAD_TORSION}""")
    out.append("""
# Hall sensors: 8-bit counts, 255 with the joint at its lower limit, about 0 at its upper one. Channel:
# order of the robot's own driver. Not covered: thumb_0 and hand_finger have one separate sensor each.""")
    for channel, joint in enumerate(HALL):
        out.append(f"""
[[hall_sensors]]
joint = "{joint}"
channel = {channel}
open = 255.0
closed = 0.0""")
    return "\n".join(out) + "\n"
