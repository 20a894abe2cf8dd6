"""The iCub's left hand of the third generation, from public figures: 11 joints, 7 motors.

Links and limits: robotology/icub-models, left_hand_mk3 (CC BY-SA 4.0). Rods: robotology/gazebo-yarp-plugins
@f837061b, ControlBoardDriverCoupling.cpp. Neither states fingertips nor stiffness: the pads are those of the
second generation, motors have 10 N m/rad.
"""

from __future__ import annotations

import numpy as np

# joint without "_joint": parent and child, origin [m], rpy [rad], axis, range [deg]
_BACK, _Z = (0, -1, 0), (0, 0, 1)
_JOINTS = {
    "index_adduction": (
        ("palm", "index_proximal"), (-0.0196675, -0.0127212, 0.006), (np.pi, 0, -0.0872664), _Z, (0, 10),
    ),
    "index_proximal": (
        ("index_proximal", "index_medial"), (0.0307135, 0.0091925, 0.0025), (0, 0, 0), _BACK, (0, 95),
    ),
    "index_distal": (("index_medial", "index_fingertip"), (0.03, 0, 0.0015), (0, 0, 0), _BACK, (0, 105.3)),
    "pinky_proximal": (
        ("palm", "pinky_medial"),
        (0.0092422, 0.0323841, 0.0031044), (3.0717795, 0, 0.0872664), _BACK, (0, 95),
    ),
    "pinky_distal": (
        ("pinky_medial", "pinky_fingertip"), (0.03, 0.008, 0.0015), (0, 0, 0), _BACK, (0, 105.3),
    ),
    "metacarpus": (
        ("palm", "metacarpus"), (-0.0931551, 0.0187629, 0.003), (0, 0, 0), (0.838671, -0.544639, 0), (0, 80),
    ),
    "thumb_rotation": (
        ("metacarpus", "thumb_proximal"), (0.0407915, -0.0481417, -0.0000456),
        (-1.9198619, 0.1745329, -1.4311699), (1, 0, 0), (-70, 0),
    ),
    "thumb_proximal": (("thumb_proximal", "thumb_medial"), (0.022, 0, 0.0035), (0, 0, 0), _BACK, (0, 85)),
    "thumb_distal": (("thumb_medial", "thumb_fingertip"), (0.02, 0, 0.0015), (0, 0, 0), _BACK, (0, 55)),
    "medium_proximal": (("palm", "medium_medial"), (0.015, 0.008, 0.0045), (np.pi, 0, 0), _BACK, (0, 95)),
    "medium_distal": (
        ("medium_medial", "medium_fingertip"), (0.03, 0.008, 0.0015), (0, 0, 0), _BACK, (0, 105.3),
    ),
}  # fmt: skip
# of the rod from the palm to the distal link [m], extended: the distal joint, the rod's end in the palm, the
# other one
_RODS = {
    "thumb": ((0.020, 0.0015), (-0.00555, 0.00285), (0.0115, 0.0014)),
    "index": ((0.030, 0.0015), (-0.0050, 0.0040), (0.0240, 0.0008)),
}
_ALONE = {"index_adduction": "index_add", "metacarpus": "thumb_add", "thumb_rotation": "thumb_oc"}
_FINGERS = {"thumb": "thumb", "index": "index", "medium": "middle", "pinky": "little"}  # their pads' names
_STIFFNESS = 10.0  # [N m/rad]


def distal_angle(finger: str, proximal: np.ndarray) -> np.ndarray:
    """Of the distal joint, at angles of the proximal one [rad]: a four-bar of finger and rod."""
    joint, base, end = map(complex, *zip(*_RODS[finger], strict=True))
    at = joint * np.exp(1j * proximal) - base  # from the rod's end in the palm
    crank, rod, far = abs(end - joint), abs(end - base), abs(at)
    corner = np.arccos((far**2 + crank**2 - rod**2) / (2 * far * crank))
    turned = np.angle(-at) + corner - np.angle(end - joint)
    return np.angle(np.exp(1j * (turned - proximal)))  # below half a turn


def mk3() -> tuple[str, str]:
    """URDF without its frame, and transmission file."""
    links, motors, rest, joints = ['<link name="palm"/>'], "", "", ""
    inertia = '<inertia ixx="2e-6" ixy="0" ixz="0" iyy="2e-6" iyz="0" izz="2e-6"/>'
    ball = '<collision><origin xyz="0.0168 0 0"/><geometry><sphere radius="0.0065"/></geometry></collision>'
    for name, ((parent, child), xyz, rpy, axis, degrees) in _JOINTS.items():
        low, high = np.radians(degrees)
        place, turned, about = (" ".join(f"{x:.9g}" for x in part) for part in (xyz, rpy, axis))
        joints += f"{name} = {{ spring = 0.0 }}\n"
        links.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}" rpy="{turned}"/><axis xyz="{about}"/>'
            f'<limit lower="{low}" upper="{high}" effort="2" velocity="3"/></joint>'
        )
        tip = ball if child.endswith("fingertip") else ""
        links.append(f'<link name="{child}"><inertial><mass value="0.01"/>{inertia}</inertial>{tip}</link>')
        if name in _ALONE:
            motors += _motor(_ALONE[name], degrees, {name: 1.0})
    for finger, name in _FINGERS.items():
        near, far = f"{finger}_proximal", f"{finger}_distal"
        most, rod = _JOINTS[near][4][1], "thumb" if finger == "thumb" else "index"
        motors += _motor(f"{finger}_flexion", (0, most + _JOINTS[far][4][1]), {near: 1.0, far: 1.0})
        angle = np.radians(most * np.linspace(0, 1, 17) ** 2)  # the rod's arm changes most where it begins
        arm = -(distal_angle(rod, angle + 1e-5) - distal_angle(rod, angle - 1e-5)) / 2e-5
        table = f"{{ angle = {angle.round(6).tolist()}, arm = {arm.round(6).tolist()} }}"
        rest += (
            f'[[loops]]\nname = "{finger}"\nmoment_arms = {{ {far} = 1.0, {near} = {table} }}\nvalue = 0.0\n'
        )
        rest += f'[[pads]]\nname = "{name}"\nlink = "{finger}_fingertip"\nstart = [0.0168, 0, 0]\n'
        rest += "radius = 0.0065\ndirection = [0, 0, 1]\n"
    return "".join(links), f'[hand]\nname = "mk3"\n[joints]\n{joints}{motors}{rest}'


def _motor(name: str, degrees: tuple[float, float], arms: dict[str, float]) -> str:
    pulled = ", ".join(f"{joint} = {arm}" for joint, arm in arms.items())
    head = f'[[actuators]]\nname = "{name}"\nrange_deg = [{degrees[0]}, {degrees[1]}]\n'
    return f"{head}moment_arms = {{ {pulled} }}\nstiffness = {_STIFFNESS}\n"
