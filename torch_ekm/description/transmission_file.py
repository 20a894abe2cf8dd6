"""Write the transmission file of a hand: with figures that have changed, or one to be filled in, with all
that its URDF or MJCF states and marks where it states nothing."""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._files import write_whole
from ..exceptions import DescriptionError, UnknownNameError
from ..typing import Array
from ._reading import TODO, read_toml
from .hand import HandDescription
from .mjcf import MjcfHand, read_mjcf
from .registry import HAND_FILES
from .transmission import unheld_of
from .urdf import UrdfModel, read_urdf

_ENDING = ".transmission.toml"


def write_transmission(hand: HandDescription, path: str | Path) -> Path:
    """Write springs, rest angles, friction, moment arms, offsets, stiffness and play of ``hand`` to ``path``.

    Everything else (ranges, couplings, pads, sensors, notes) is that of ``hand.transmission_path``; comments
    are lost. The URDF is copied next to it if there is none, so that ``load_hand`` reads the hand back; an
    MJCF is not, since it may be of several files.

    Args:
        hand: its description.
        path: ends in ".transmission.toml".

    Raises:
        DescriptionError: another ending, or the file that the hand was read from is gone.
        OutputError: the folder cannot be written to.
    """
    path = Path(path)
    if not path.name.endswith(_ENDING):
        raise DescriptionError(path, f"the name must end in '{_ENDING}'")
    if hand.transmission_path.is_file() or hand.urdf_path.suffix == ".urdf":
        data = read_toml(hand.transmission_path, "transmission file")
    else:
        data = read_mjcf(hand.urdf_path).tables
    for j, name in enumerate(hand.joint_names):
        data["joints"][name] = {
            "spring": float(hand.spring_stiffness[j]),
            "rest": float(hand.spring_rest[j]),
            "friction": float(hand.joint_friction[j]),
        }
    rows = zip(hand.actuators, data["actuators"], hand.actuation_jacobian, hand.lengths.typical, strict=True)
    for actuator, table, arms, typical in rows:
        _write_arms(hand, table, arms * actuator.unit, typical)
        for key in ("stiffness", "offset", "offset_deg", "backlash", "backlash_deg"):
            table.pop(key, None)
        if math.isfinite(actuator.stiffness):
            table["stiffness"] = float(actuator.stiffness) / actuator.unit**2
        for key in ("offset", "backlash"):
            if getattr(actuator, key):
                table[key] = float(getattr(actuator, key)) * actuator.unit
    write_whole(path, document(data))
    urdf = path.with_name(path.name.removesuffix(_ENDING) + ".urdf")
    if not urdf.exists() and hand.urdf_path.suffix == ".urdf":
        write_whole(urdf, hand.urdf_path.read_bytes())
    return path


def _write_arms(hand: HandDescription, table: dict[str, Any], arms: Array, typical: Array) -> None:
    """Constant arms as they are now, functions and tendons by the factors of their typical ones."""
    if "mjcf_tendons" in table:
        factor = float(arms @ typical) / float(typical @ typical)
        table["mjcf_tendons"] = {name: factor * weight for name, weight in table["mjcf_tendons"].items()}
        return
    written: dict[str, Any] = {}
    for name, arm, was in zip(hand.joint_names, arms.tolist(), typical.tolist(), strict=True):
        value = table["moment_arms"].get(name, 0.0)
        if isinstance(value, list):
            value = [coefficient * arm / was for coefficient in value]
        elif isinstance(value, dict):
            value = value | {"arm": [one * arm / was for one in value["arm"]]}
        elif arm != 0:
            value = arm
        else:
            continue
        written[name] = value
    table["moment_arms"] = written


def document(data: dict[str, Any]) -> str:
    """Tables of a transmission file as TOML."""
    lines: list[str] = []
    for name, value in data.items():
        for table in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
            lines += [f"{toml_key(key)} = {_value(entry)}" for key, entry in table.items()]
    return "\n".join(lines[1:]) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(key)} = {_value(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    # numbers, booleans and strings are written alike in JSON and in TOML
    return json.dumps(value, ensure_ascii=False)


def toml_key(key: str) -> str:
    """A key as it is written in TOML."""
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)


_ROUND = ("capsule", "sphere")
_ONE_PLANE = 1e-3  # [m]
_MANY = 40  # joints: more than a hand has
ASSUMED = "# Assumed: "
"""Begins a line of the file that says what was assumed."""
_HEAD = """\
# What {urdf} cannot describe of this hand. Begun by 'torch-ekm hands --new'.
# Put a figure wherever "TODO" stands; 'torch-ekm check {urdf}' lists what is missing.
# Angles in rad, or in deg where the key ends in _deg; lengths in m; torques in N m.
# A joint that closes its finger with negative angles has a negative moment arm.
# All keys: docs/reference/file_formats.md;
# springs and moment arms from recorded motions: docs/how_to/drive_a_real_hand.md

[hand]
name = {name}
base_link = {base}  # the hand frame: poses, contacts and Jacobians are expressed in it
gravity = [0.0, 0.0, 9.81]  # [m/s^2] in the hand frame; as it stands, the palm faces down
"""
_MJCF_HEAD = """\
# Transmission of {mjcf}, as read by 'torch-ekm hands --new'; this file takes precedence from now on.
# Put a figure wherever "TODO" stands; 'torch-ekm check {mjcf}' lists what is missing.
# Angles in rad, or in deg where the key ends in _deg; lengths in m; torques in N m.
# All keys: docs/reference/file_formats.md
"""
_JOINTS = """
# spring [N m/rad]: stiffness of the return spring, 0.0 where there is none (0.01 to 0.2 in fingers);
# rest_deg [deg]: angle at which it is slack; friction [N m]: Coulomb friction.
[joints]
"""
_ACTUATORS = """
# One table for each motor: a = offset + sum of moment arm * joint angle.
# range_deg [deg]: smallest and largest a. moment_arms [1]: radius of the joint's pulley over the motor's;
# leave out joints that it does not pull. tendon = true: can only pull; false: looped cable or gear.
# stiffness [N m/rad]: of tendon and servo in series; leave it out if rigid.
# This guess has one tendon for each finger: change, add or remove tables.
"""
_PADS = """
# The parts that touch objects, as capsules in the link's frame: all points within radius [m] of the segment
# from start to end [m]. direction: outward, the middle of the side that touches. For simulation their links
# need the same shapes: in a URDF a cylinder with a ball on either end, in an MJCF a capsule; or a sphere.
# A pinch in simulation is of the pad whose name begins with thumb, else of the one that faces the others
# best; it presses against index* and middle*, where both are there, else against all others.
"""


def write_template(urdf: str | Path, base_link: str | None = None) -> Path:
    """Write ``<stem>.transmission.toml`` next to a URDF: all joints, and couplings for ``<mimic>``.

    Of an MJCF: all that it says of its transmission. Above stands what was assumed of the file.
    Figures that the file does not state are ``"TODO"``; as long as one is left, ``load_hand`` names them all.

    Args:
        urdf: a path that ends in ".urdf", ".xml" or ".mjcf".
        base_link: of a robot: the hand is what this link carries.

    Raises:
        UnknownNameError: another ending.
        DescriptionError: the file is missing or wrong, has no such link or no joint that moves, or its
            transmission file is there already.
        OutputError: the folder cannot be written to.
    """
    path = Path(urdf)
    if path.suffix not in HAND_FILES:
        raise UnknownNameError("URDF or MJCF", str(urdf), ("a path to a .urdf, .xml or .mjcf file",))
    mjcf = read_mjcf(path, base_link) if path.suffix != ".urdf" else None
    model = read_urdf(path) if mjcf is None else mjcf.urdf
    model = model.below(base_link or model.root)
    notes = list(model.notes)
    if base_link is None and (count := len(model.moving_joints)) > _MANY:
        notes.append(f"all {count} joints are the hand's; of a robot, --base LINK keeps those beyond a link")
    written = path.with_suffix(".transmission.toml")
    if not model.moving_joints:
        raise DescriptionError(path, "; ".join(["there is no revolute or continuous joint", *notes]))
    if written.exists():
        raise DescriptionError(written, "is there already and is not overwritten; move it away first")
    text = template(model, base_link) if mjcf is None else mjcf_template(mjcf)
    said = "".join(f"{ASSUMED}{_comment(note)}\n" for note in notes)
    write_whole(written, text.replace("\n[hand]\n", f"{said}\n[hand]\n", 1))
    return written


def mjcf_template(mjcf: MjcfHand) -> str:
    """The text of the transmission file of an MJCF, with TODO for pads, and for what it needs and has not."""
    head = _MJCF_HEAD.format(mjcf=_comment(mjcf.urdf.path.name)).rstrip("\n")
    joints = mjcf.tables["joints"]
    loose = {name: joints[name] | {"spring": TODO} for name in unheld_of(mjcf)}
    tables = mjcf.tables | {"joints": joints | loose}
    lines = [head, "", document(tables).rstrip("\n")]
    if not mjcf.tables["actuators"]:
        lines += _actuators(mjcf.urdf)
    return "\n".join([*lines, *_pads(mjcf.urdf)]) + "\n"


def template(model: UrdfModel, base_link: str | None = None) -> str:
    """The text of the transmission file, with TODO where the URDF has no figure."""
    base = base_link or _base(model)
    normal = _planar_normal(model, base)
    head = _HEAD.format(urdf=_comment(model.path.name), name=_text(model.name), base=_text(base))
    lines = [head.rstrip("\n")]
    if normal is not None:
        lines.append(f"planar_normal = {_vector(normal)}  # all joints turn in one plane: a planar hand")
    lines += [_JOINTS.rstrip("\n"), *_joints(model), *_couplings(model)]
    return "\n".join([*lines, *_actuators(model), *_pads(model)]) + "\n"


def _actuators(model: UrdfModel) -> Iterator[str]:
    yield _ACTUATORS.rstrip("\n")
    for k, finger in enumerate(_fingers(model), start=1):
        yield from _actuator(model, finger, f"finger_{k}")


def _pads(model: UrdfModel) -> Iterator[str]:
    yield _PADS.rstrip("\n")
    for k, finger in enumerate(_fingers(model), start=1):
        thumb = any("thumb" in link.lower() for link in finger)
        yield from _pad(model, _fingertip(model, finger[-1]), f"thumb_{k}" if thumb else f"tip_{k}")


def _joints(model: UrdfModel) -> Iterator[str]:
    tied = {mimic.joint: mimic for mimic in model.mimics}
    rest = {joint.name: min(max(0.0, joint.lower), joint.upper) for joint in model.moving_joints}
    for _ in tied:  # as many sweeps as ties reach the end of a chain of them
        rest |= {name: tie.multiplier * rest.get(tie.other, 0.0) + tie.offset for name, tie in tied.items()}
    for joint in model.moving_joints:
        limits = f"{math.degrees(joint.lower):.6g} to {math.degrees(joint.upper):.6g} deg"
        limits = limits if math.isfinite(joint.lower + joint.upper) else "no limits"
        about = f"{joint.kind}, {limits}, from {_comment(joint.parent)} to {_comment(joint.child)}"
        spring = "0.0" if joint.name in tied or joint.lower == joint.upper else _text(TODO)
        if joint.name in tied:
            tie = tied[joint.name]
            about += f", tied to {_comment(tie.other)}" if tie.multiplier else ", locked"
        figures = f"spring = {spring}, rest_deg = {math.degrees(rest[joint.name]):.9g}, friction = 0.0"
        yield f"{toml_key(joint.name)} = {{ {figures} }}  # {about}"


def _couplings(model: UrdfModel) -> Iterator[str]:
    """Sum of weight * joint angle stays what it is at rest."""
    rows = [
        (f"{tie.joint} mimics {tie.other}" if tie.multiplier else f"{tie.joint} is locked", tie.coupling())
        for tie in model.mimics
    ]
    tied = {tie.joint for tie in model.mimics}
    for joint in model.moving_joints:
        if joint.lower == joint.upper and joint.name not in tied:
            rows.append((f"{joint.name} is locked", {joint.name: 1.0}))
    if rows:
        yield "\n# Rigid couplings, from <mimic> and from joints whose limits are equal:"
        yield "# the sum of weight * angle stays what it is at rest."
    for name, weights in rows:
        shown = ", ".join(f"{toml_key(joint)} = {weight:.9g}" for joint, weight in weights.items())
        yield f"\n[[couplings]]\nname = {_text(name)}\njoints = {{ {shown} }}"


def _actuator(model: UrdfModel, links: list[str], name: str) -> Iterator[str]:
    tied = {tie.joint for tie in model.mimics}
    free = [j for j in model.moving_joints if j.child in links and j.name not in tied and j.lower < j.upper]
    if not free:
        return
    arms = ", ".join(f"{toml_key(joint.name)} = {_text(TODO)}" for joint in free)
    yield f"\n[[actuators]]  # the finger that ends in {_comment(links[-1])}\nname = {_text(name)}"
    yield f"range_deg = [{_text(TODO)}, {_text(TODO)}]\nmoment_arms = {{ {arms} }}\ntendon = true"
    yield "# stiffness = 4.0"


def _pad(model: UrdfModel, link: str, name: str) -> Iterator[str]:
    yield f"\n[[pads]]\nname = {_text(name)}\nlink = {_text(link)}"
    round_shapes = [s for s in model.link(link).collisions if s.kind in _ROUND]
    if round_shapes:
        shape = round_shapes[-1]
        half = 0.5 * shape.size[1] * shape.transform[:3, 2] if shape.kind == "capsule" else np.zeros(3)
        start, end = shape.transform[:3, 3] - half, shape.transform[:3, 3] + half
        yield f"start = {_vector(start)}\nend = {_vector(end)}"
        yield f"radius = {shape.size[0]:.9g}  # as <collision>"
    else:
        todo = f"[{', '.join([_text(TODO)] * 3)}]"
        yield f"start = {todo}\nend = {todo}\nradius = {_text(TODO)}"
    yield f"direction = [{', '.join([_text(TODO)] * 3)}]  # outward, e.g. [0.0, 1.0, 0.0]"


def _base(model: UrdfModel) -> str:
    """The last link that every joint that moves is beyond, from the root on."""
    base = model.root
    while True:
        joints = [joint for joint in model.joints if joint.parent == base]
        if len(joints) != 1 or joints[0].kind != "fixed":
            return base
        base = joints[0].child


def _fingers(model: UrdfModel) -> list[list[str]]:
    """Links of each chain from the base to a link that moves and carries no other that does."""
    moving = [joint.child for joint in model.moving_joints]
    chains = [[joint.child for joint in model.joints_to(link) if joint.child in moving] for link in moving]
    inner = {link for links in chains for link in links[:-1]}
    return [links for links in chains if links[-1] not in inner]


def _fingertip(model: UrdfModel, link: str) -> str:
    """The farthest link on fixed joints beyond it that has a capsule or sphere to touch with; else itself."""
    tip, reached = link, [link]
    for carrier in reached:
        reached += [joint.child for joint in model.joints if joint.parent == carrier]  # nothing moves there
        if any(shape.kind in _ROUND for shape in model.link(carrier).collisions):
            tip = carrier
    return tip


def _planar_normal(model: UrdfModel, base: str) -> np.ndarray | None:
    """The common direction of all axes, in the base's frame at zero angles; None: there is none.

    Nor is there one where joints lie in several parallel planes: their fingers hold an object in space.
    """
    base_pose = model.pose(base)
    frames = [np.linalg.inv(base_pose) @ model.pose(joint.child) for joint in model.moving_joints]
    axes = [T[:3, :3] @ joint.axis for T, joint in zip(frames, model.moving_joints, strict=True)]
    normal = axes[0] * np.sign(axes[0][np.abs(axes[0]).argmax()])
    heights = [float(normal @ T[:3, 3]) for T in frames]
    parallel = all(np.linalg.norm(np.cross(normal, axis)) < 1e-6 for axis in axes)
    return normal if parallel and max(heights) - min(heights) < _ONE_PLANE else None


def _vector(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{float(x):.9g}" for x in values.round(12) + 0.0) + "]"


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=True)


def _comment(text: str) -> str:
    """A name of a file, on one line whatever it holds."""
    return json.dumps(text, ensure_ascii=True)[1:-1]
