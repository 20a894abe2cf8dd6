"""Described hands of the kinds that owners have: URDF and transmission file, for a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from mk3 import mk3


def _link(name: str, length: float, more: str = "") -> str:
    body = '<inertial><origin xyz="0.02 0 0"/><mass value="0.01"/>'
    body += '<inertia ixx="2e-7" ixy="0" ixz="0" iyy="2e-6" iyz="0" izz="2e-6"/></inertial>'
    rod = f'<cylinder radius="0.004" length="{length}"/>'
    at = f'<origin xyz="{length / 2} 0 0" rpy="0 1.5708 0"/>'
    return f'<link name="{name}">{body}<collision>{at}<geometry>{rod}</geometry></collision>{more}</link>'


def _joint(
    name: str, parent: str, child: str, at: str, turn: float, side: int, low: float, high: float
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}" rpy="0 0 {turn}"/>'
    limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="2"/>'
    return f'<joint name="{name}" type="revolute">{ends}<axis xyz="0 0 {side}"/>{limit}</joint>'


def _ball(x: float) -> str:
    sphere = '<geometry><sphere radius="0.006"/></geometry>'
    return f'<collision><origin xyz="{x} 0 0"/>{sphere}</collision>'


def _gripper(more: str = "") -> str:
    """Two planar fingers of two joints, 60 mm apart."""
    parts = ['<link name="hand"/>']
    for side, x, turn in (("left", -0.03, -1), ("right", 0.03, 1)):
        parts += [
            _joint(f"{side}_0", "hand", f"{side}_near", f"{x} 0 0", 1.5708, turn, -0.5, 1.5),
            _link(f"{side}_near", 0.03),
            _joint(f"{side}_1", f"{side}_near", f"{side}_far", "0.04 0 0", 0.0, turn, -0.5, 1.5),
            _link(f"{side}_far", 0.03, _ball(0.03)),
        ]
    return "".join(parts) + more


def _pads() -> str:
    return "".join(
        f'[[pads]]\nname = "{side}"\nlink = "{side}_far"\nstart = [0.03, 0, 0]\nradius = 0.006\n'
        f"direction = [0, {y}, 0]\n"
        for side, y in (("left", -1), ("right", 1))
    )


def _head(springs: dict[str, float], more: str = "") -> str:
    joints = "".join(f"{name} = {{ spring = {k} }}\n" for name, k in springs.items())
    return f'[hand]\nname = "made"\nplanar_normal = [0, 0, 1]\n[joints]\n{joints}{more}'


def _springs(near: float = 0.2, far: float = 0.1) -> dict[str, float]:
    return {f"{side}_{k}": spring for side in ("left", "right") for k, spring in ((0, near), (1, far))}


def _tendon(side: str, near: str, far: str, stiffness: float = 10.0, most: float = 2.618) -> str:
    arms = f"{{ {side}_0 = {near}, {side}_1 = {far} }}"
    return (
        f'[[actuators]]\nname = "{side}"\nrange = [0, {most}]\nmoment_arms = {arms}\ntendon = true\n'
        f"stiffness = {stiffness}\n"
    )


def _both(near: str, far: str, stiffness: float = 10.0, most: float = 2.618) -> str:
    return "".join(_tendon(side, near, far, stiffness, most) for side in ("left", "right"))


def _round() -> tuple[str, str]:
    return _gripper(), _head(_springs()) + _both("1.0", "0.8") + _pads()


def _tendon_springs() -> tuple[str, str]:
    over = "".join(
        f'[[tendon_springs]]\nname = "{side}"\nmoment_arms = {{ {side}_1 = 0.01 }}\nstiffness = 1000\n'
        "slack = [-inf, 0.0]\n"
        for side in ("left", "right")
    )
    return _gripper(), _head(_springs(far=0.0)) + _both("1.0", "0.8") + over + _pads()


def _not_round() -> tuple[str, str]:
    """Arms that shrink by a quarter and by two fifths as the joints bend."""
    near, far = "[0.95, -0.15, -0.05]", "{ angle = [-0.5, 0.3, 0.9, 1.5], arm = [1.15, 1.05, 0.85, 0.7] }"
    return _gripper(), _head(_springs()) + _both(near, far) + _pads()


def _four_bar() -> tuple[str, str]:
    """The first joint of each finger is the rocker of a four-bar whose crank is driven."""
    more, loops, motors = "", "", ""
    springs = _springs(0.05, 0.1)
    for side, x, turn in (("left", -0.03, -1), ("right", 0.03, 1)):
        out = -0.015 if side == "left" else 0.015
        more += _joint(f"{side}_c", "hand", f"{side}_crank", f"{x + out} -0.005 0", 1.5708, turn, -0.8, 1.6)
        more += _link(f"{side}_crank", 0.02)
        more += _joint(f"{side}_b", f"{side}_crank", f"{side}_bar", "0.025 0 0", -1.5708, turn, -1.5, 1.5)
        more += _link(f"{side}_bar", 0.01)
        springs |= {f"{side}_c": 0.0, f"{side}_b": 0.0}
        end = 0.015 if side == "right" else -0.015
        loops += (
            f'[[loops]]\nname = "{side}"\nlinks = ["{side}_bar", "{side}_near"]\n'
            f"points = [[{-end}, 0, 0], [0.02, 0, 0]]\n"
        )
        motors += (
            f'[[actuators]]\nname = "{side}"\nrange = [-0.6, 1.5]\nmoment_arms = {{ {side}_c = 1.0 }}\n'
            "stiffness = 10.0\n"
        )
        motors += (
            f'[[actuators]]\nname = "{side}_tip"\nrange = [-0.5, 1.5]\nmoment_arms = {{ {side}_1 = 1.0 }}\n'
            "stiffness = 10.0\n"
        )
    return _gripper(more), _head(springs) + motors + loops + _pads()


def _servos(coupled: bool = False) -> tuple[str, str]:
    """Sixteen motors on sixteen joints, nothing else: a thumb against three fingers, in space; or the last
    joint of each finger is coupled to the one before it."""
    parts, motors, joints, pads = ['<link name="palm"/>'], "", {}, ""
    for name, x, y, side in (
        ("thumb", 0.06, 0.0, -1), ("index", 0.0, -0.028, 1), ("middle", 0.0, 0.0, 1), ("ring", 0.0, 0.028, 1)
    ):  # fmt: skip
        before, at = "palm", f"{x} {y} 0.01"
        for k, (axis, low, high) in enumerate((("0 0 1", -0.4, 0.4), *3 * [(f"0 {side} 0", -0.3, 1.5)])):
            joint, link = f"{name}_{k}", f"{name}_link_{k}"
            ends = f'<parent link="{before}"/><child link="{link}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
            limit = f'<limit lower="{low}" upper="{high}" effort="2" velocity="3"/>'
            parts.append(f'<joint name="{joint}" type="revolute">{ends}{limit}</joint>')
            long = (0.0, 0.04, 0.03, 0.025)[k]
            ball = '<geometry><sphere radius="0.008"/></geometry>'
            tip = f'<collision><origin xyz="0 0 {long}"/>{ball}</collision>' if k == 3 else ""
            inertia = '<inertia ixx="2e-6" ixy="0" ixz="0" iyy="2e-6" iyz="0" izz="2e-6"/>'
            parts.append(
                f'<link name="{link}"><inertial><mass value="0.01"/>{inertia}</inertial>{tip}</link>'
            )
            before, at, joints[joint] = link, f"0 0 {long}", 0.0
            if coupled and k == 3:
                tie = f"{{ {joint} = 1.0, {name}_2 = -0.8 }}"
                motors += f'[[couplings]]\nname = "{joint}"\njoints = {tie}\n'
                continue
            motors += f'[[actuators]]\nname = "m_{joint}"\nrange = [{low}, {high}]\n'
            motors += f"moment_arms = {{ {joint} = 1.0 }}\nstiffness = 10.0\n"
        pads += f'[[pads]]\nname = "{name}"\nlink = "{before}"\nstart = [0, 0, 0.025]\nradius = 0.008\n'
        pads += f"direction = [{side}, 0, 0]\n"
    head = _head(joints).replace("planar_normal = [0, 0, 1]\n", "")
    return "".join(parts), head + motors + pads


def _coupled() -> tuple[str, str]:
    return _servos(coupled=True)


def _stiff() -> tuple[str, str]:
    return _gripper(), _head(_springs()) + _both("1.0", "0.8", stiffness=20.0) + _pads()


def _metres() -> tuple[str, str]:
    return _gripper(), _head(_springs()) + _both("0.01", "0.008", 1e5, 0.02618) + _pads()


def _idle() -> tuple[str, str]:
    more = _joint("spare", "hand", "spare", "-0.12 0 0", 1.5708, 1, 0.0, 1.5) + _link("spare", 0.03)
    preloaded = "spare = { spring = 0.1, rest = -1.0 }\n"
    motor = (
        '[[actuators]]\nname = "spare"\nrange = [0, 1.5]\nmoment_arms = { spare = 1.0 }\ntendon = true\n'
        "stiffness = 10.0\n"
    )
    return _gripper(more), _head(_springs(), preloaded) + _both("1.0", "0.8") + motor + _pads()


def _jaw() -> tuple[str, str]:
    """A finger on a slide, which is set by hand: the width of the grip."""
    links, transmission = _round()
    slide = '<joint name="slide" type="prismatic"><parent link="hand"/><child link="jaw"/><axis xyz="1 0 0"/>'
    slide += '<limit lower="-0.01" upper="0.01" effort="10" velocity="1"/></joint>'
    child = '<child link="left_near"/>'
    links = links.replace(f'<parent link="hand"/>{child}', f'<parent link="jaw"/>{child}')
    return links + slide + _link("jaw", 0.005), transmission


_MADE: dict[str, Callable[[], tuple[str, str]]] = {
    "tendon_springs": _tendon_springs, "four_bar": _four_bar, "not_round": _not_round, "servos": _servos,
    "stiff": _stiff, "metres": _metres, "jaw": _jaw, "idle": _idle, "coupled": _coupled, "round": _round,
    "mk3": mk3,
}  # fmt: skip
KINDS = tuple(_MADE)[:9]
"""Nine kinds of hands; "round" is none of them but a reference, "mk3" a public hand."""


def write_hand(kind: str, folder: Path) -> Path:
    """The URDF of a hand of this kind, with its transmission file next to it."""
    links, transmission = _MADE[kind]()
    path = folder / f"{kind}.urdf"
    path.write_text(f'<robot name="{kind}">{links}</robot>')
    path.with_suffix(".transmission.toml").write_text(transmission)
    return path


def write_hands(folder: Path) -> Iterator[Path]:
    """All nine."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        yield write_hand(kind, folder)
