"""Read a transmission file: what a URDF cannot describe of a hand.

Actuators and their moment arms (J_a), rigid couplings (C dq = 0), loops, springs over joints and tendons,
contact pads, Hall sensors. The format is documented in ``docs/reference/file_formats.md``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..exceptions import DescriptionError, JointMismatchError
from ..typing import Array
from ._reading import TODO, TomlTable, listed, read_toml
from .hand import Actuator, ContactPad, HallSensor, HandDescription
from .length_tables import LOOP, SPRING, LengthReader
from .mimic import overruled, unheld_joints
from .mjcf import MjcfHand
from .urdf import UrdfJoint, UrdfModel

TABLES = (
    "hand", "joints", "actuators", "couplings", "tendon_springs", "loops", "pads", "hall_sensors", "notes",
)  # fmt: skip
HAND = ("name", "base_link", "planar_normal", "gravity", "pinch_force")
JOINT = ("spring", "rest", "rest_deg", "friction")
ACTUATOR = (
    "name", "range", "range_deg", "offset", "offset_deg", "moment_arms", "mjcf_tendons", "tendon",
    "stiffness", "backlash", "backlash_deg", "posture",
)  # fmt: skip
COUPLING = ("name", "joints")
PAD = ("name", "link", "start", "end", "radius", "direction", "torsional_friction")
HALL = ("joint", "channel", "open", "closed")
_TURN = 6.3  # [rad]


def read_transmission(path: Path, urdf: UrdfModel, mjcf: MjcfHand | None = None) -> HandDescription:
    """The hand described by ``urdf`` and the transmission file at ``path``; without the file, by ``mjcf``.

    Raises:
        DescriptionError: no such file, malformed TOML, an unknown key, a figure that is not finite,
            reversed ranges, dependent rows in ``[J_a; C]``, a motion that no spring, actuator or
            coupling holds.
        JointMismatchError: the file names joints that the URDF lacks, or leaves some out.
    """
    written = path
    if mjcf is not None and not path.is_file():
        data, path = mjcf.tables, urdf.path  # which errors then name
    elif not path.is_file():
        problem = f"no such transmission file; 'torch-ekm hands --new {urdf.path}' begins one"
        raise DescriptionError(path, problem)
    else:
        data = read_toml(path, "transmission file")
    _check_filled_in(path, data)
    hand = replace(_hand(path, data, urdf, mjcf), transmission_path=written)
    _check_mechanism(path, hand, [table["name"] for table in data.get("couplings", [])])
    return hand


def _hand(path: Path, data: dict[str, Any], urdf: UrdfModel, mjcf: MjcfHand | None) -> HandDescription:
    top = TomlTable(path, "top level", data, TABLES)
    if not isinstance(data.get("notes", {}), dict):
        raise top.error("'notes' must be a table of text, which no program reads")
    hand = TomlTable(path, "[hand]", data.get("hand"), HAND)
    base, given = hand.text("base_link", urdf.root), data.get("joints", {})
    robot, urdf = urdf, urdf.below(base, given if isinstance(given, dict) else (), path)
    joints = urdf.moving_joints
    names = tuple(joint.name for joint in joints)
    if not names:
        raise hand.error(f"base_link '{base}' carries no revolute or continuous joint")
    spring, rest, friction = _joint_table(path, given, names, {joint.name for joint in robot.joints}).T
    reader = LengthReader(urdf, names, rest, mjcf)
    motors = _each(top, "actuators", ACTUATOR)
    lengths = reader.lengths(motors)
    C = _couplings(_each(top, "couplings", COUPLING), names)
    actuators = tuple(map(_actuator, motors))
    pads = tuple(_pad(table, urdf) for table in _each(top, "pads", PAD))
    hall = tuple(_hall(table, names) for table in _each(top, "hall_sensors", HALL))
    _check_unique(path, "actuator", [actuator.name for actuator in actuators])
    _check_unique(path, "pad", [pad.name for pad in pads])
    _check_unique(path, "Hall channel", [str(sensor.channel) for sensor in hall])
    return HandDescription(
        name=hand.text("name"),
        urdf=urdf,
        transmission_path=path,
        base_link=base,
        link_names=tuple(link.name for link in urdf.links),
        joint_names=names,
        joint_lower=np.array([joint.lower for joint in joints]),
        joint_upper=np.array([joint.upper for joint in joints]),
        actuators=actuators,
        actuation_jacobian=lengths.typical,
        coupling=C,
        spring_stiffness=spring,
        spring_rest=rest,
        joint_friction=friction,
        pads=pads,
        hall_sensors=hall,
        planar_normal=_point(hand.vector("planar_normal", 3)) if "planar_normal" in hand.data else None,
        gravity=_point(hand.vector("gravity", 3, HandDescription.gravity)),
        pinch_force=hand.number("pinch_force", HandDescription.pinch_force, positive=True),
        notes=(*urdf.notes, *overruled(urdf.mimics, names, C, rest), *_odd_limits(joints, C)),
        arm_functions=None if lengths.constant else lengths,
        tendon_springs=reader.springs(_each(top, "tendon_springs", SPRING)),
        loops=reader.loops(_each(top, "loops", LOOP)),
    )


def unheld(hand: HandDescription) -> list[str]:
    """Joints that no spring, actuator, coupling or loop holds at rest, as if all springs of tendons were
    stretched."""
    rows, K = np.vstack([hand.actuation_jacobian, hand.coupling]), np.diag(hand.spring_stiffness)
    if (springs := hand.tendon_springs) is not None:
        arms = springs.lengths.typical
        K = K + arms.T @ (springs.stiffness[:, None] * arms)
    if hand.loops is not None:
        rows = np.vstack([rows, hand.loops.lengths.jacobian(hand.spring_rest)])
    return unheld_joints(hand.joint_names, rows, K)


def unheld_of(mjcf: MjcfHand) -> list[str]:
    """The joints of an MJCF that nothing holds, as far as it says, whatever the ranges of its motors."""
    motors = [table | {"range": [0.0, 1.0]} for table in mjcf.tables["actuators"]]
    return unheld(_hand(mjcf.urdf.path, mjcf.tables | {"actuators": motors}, mjcf.urdf, mjcf))


def _check_filled_in(path: Path, data: dict[str, Any]) -> None:
    """Figures of a template that nobody has filled in yet, all of them in one message."""

    def places(value: Any, name: str) -> Iterator[str]:
        parts = list(value.values()) if isinstance(value, dict) else value
        parts = parts if isinstance(parts, list) else []
        if value == TODO or (parts and all(part == TODO for part in parts)):
            yield name
        elif isinstance(value, dict):
            for key, part in value.items():
                yield from places(part, f"{name}.{key}")
        elif isinstance(value, list):
            for k, part in enumerate(value):
                label = part.get("name", k + 1) if isinstance(part, dict) else k + 1
                yield from places(part, f"{name}[{label}]")

    left = [place for key, value in data.items() for place in places(value, key)]
    if left:
        raise DescriptionError(path, f"still to be filled in: {', '.join(left)}{_where(path)}")


def _each(top: TomlTable, key: str, valid: tuple[str, ...]) -> list[TomlTable]:
    entries = top.data.get(key, [])
    if not isinstance(entries, list):
        raise DescriptionError(top.path, f"'{key}' must be written as [[{key}]], one table for each")
    tables = []
    for k, data in enumerate(entries):
        label = data.get("name", data.get("joint", k + 1)) if isinstance(data, dict) else k + 1
        tables.append(TomlTable(top.path, f"[[{key}]] '{label}'", data, valid))
    return tables


def _actuator(table: TomlTable) -> Actuator:
    lower, upper = table.angles("range", 2)
    if lower >= upper:
        raise table.error(f"range reversed or empty: {lower:g} to {upper:g} rad")
    backlash = table.angle("backlash", 0.0)
    if backlash < 0:
        raise table.error(f"'backlash' must be at least 0, got {backlash:g} rad")
    return Actuator(
        name=table.text("name"),
        lower=lower,
        upper=upper,
        offset=table.angle("offset", 0.0),
        tendon=table.flag("tendon", False),
        stiffness=table.number("stiffness", np.inf, positive=True),
        backlash=backlash,
        posture=table.flag("posture", False),
    )


def _point(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _pad(table: TomlTable, urdf: UrdfModel) -> ContactPad:
    link, links = table.text("link"), [link.name for link in urdf.links]
    if link not in links:
        raise table.error(f"unknown link '{link}'; the URDF's links are: {', '.join(links)}")
    start = table.vector("start", 3)
    direction = np.array(table.vector("direction", 3, ContactPad.direction))
    if np.linalg.norm(direction) < 1e-9:
        raise table.error("'direction' must not be zero")
    return ContactPad(
        name=table.text("name"),
        link=link,
        start=_point(start),
        end=_point(table.vector("end", 3, start)),
        radius=table.number("radius", positive=True),
        direction=_point(tuple((direction / np.linalg.norm(direction)).tolist())),
        torsional_friction=table.number("torsional_friction", 0.0, minimum=0.0),
    )


def _hall(table: TomlTable, names: tuple[str, ...]) -> HallSensor:
    joint = table.text("joint")
    if joint not in names:
        raise JointMismatchError(table.path, (), (joint,), names)
    return HallSensor(joint, table.whole("channel"), table.number("open", 255.0), table.number("closed", 0.0))


def _joint_table(path: Path, data: Any, names: tuple[str, ...], robot: set[str]) -> np.ndarray:
    """Rows (spring stiffness [N m/rad], rest [rad], Coulomb friction [N m]) in the order of ``names``.

    Other joints of the ``robot`` may be there.
    """
    given = TomlTable(path, "[joints]", data, data if isinstance(data, dict) else ()).data
    missing = [name for name in names if name not in given]
    unexpected = [name for name in given if name not in names and name not in robot]
    if missing or unexpected:
        raise JointMismatchError(path, missing, unexpected, names)
    rows = []
    for name in names:
        table = TomlTable(path, f"[joints] {name}", given[name], JOINT)
        spring, friction = (table.number(key, 0.0, minimum=0.0) for key in ("spring", "friction"))
        rows.append((spring, table.angle("rest", 0.0), friction))
    return np.array(rows)


def _couplings(tables: list[TomlTable], names: tuple[str, ...]) -> np.ndarray:
    matrix = np.zeros((len(tables), len(names)))
    for row, table in zip(matrix, tables, strict=True):
        weights = table.weights("joints")
        table.text("name")
        if unexpected := [name for name in weights if name not in names]:
            raise JointMismatchError(table.path, (), unexpected, names)
        for name, weight in weights.items():
            row[names.index(name)] = weight
    return matrix


def _check_mechanism(path: Path, hand: HandDescription, couplings: list[str]) -> None:
    """``[J_a; C]`` must have full row rank, and springs and loops must hold what it leaves free."""
    if not hand.n_a:
        raise DescriptionError(path, "[[actuators]]: at least 1 such table(s) must be given")
    B = np.vstack([hand.actuation_jacobian, hand.coupling])
    U, singular, _ = np.linalg.svd(B)
    rank = int((singular > 1e-9 * singular[0]).sum())
    if rank < len(B):
        names = [*hand.actuator_names, *couplings]
        alike = [name for name, part in zip(names, np.abs(U[:, rank:]), strict=True) if part.max() > 1e-6]
        parts = f"{hand.n_a} actuators and {len(couplings)} couplings give only {rank} independent rows"
        parts = f"{parts}; one or more of these move nothing of their own: {', '.join(alike)}"
        raise DescriptionError(path, f"moment arms and couplings must be linearly independent: {parts}")
    if loose := unheld(hand):
        problem = f"no spring, actuator or coupling holds the joints {', '.join(loose)}"
        problem += f": give them a positive 'spring' in [joints]{_where(path)}"
        raise DescriptionError(path, problem)


def _where(path: Path) -> str:
    """What an MJCF does not say stands in a file next to it."""
    remedy = f" of a transmission file; 'torch-ekm hands --new {path}' writes one"
    return "" if path.suffix == ".toml" else remedy


def _odd_limits(joints: Iterable[UrdfJoint], C: Array) -> list[str]:
    """Notes on limits that may be meant otherwise: in degrees, or left out."""
    wide = [j.name for j in joints if _TURN < max(-j.lower, j.upper) < np.inf]
    still = [j.name for k, j in enumerate(joints) if j.lower == j.upper and not (C[:, k] != 0).any()]
    notes = [listed("limits beyond a whole turn, in rad; are they in deg?", wide)] if wide else []
    return notes + ([listed("equal limits lock joints", still)] if still else [])


def _check_unique(path: Path, kind: str, names: Iterable[str]) -> None:
    names = list(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DescriptionError(path, f"each {kind} must be unique, repeated: {', '.join(twice)}")
