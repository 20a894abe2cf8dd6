"""The hands and objects that come with torch_ekm, by name; any other by path."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from .._files import read_file
from ..exceptions import DescriptionError, UnknownNameError
from ._reading import LARGEST, read_toml
from .hand import HandDescription
from .mjcf import mjcf_files, read_mjcf
from .objects import ObjectDescription, read_object
from .transmission import read_transmission
from .urdf import read_urdf

HAND_FILES = (".urdf", ".xml", ".mjcf")
"""How the file of a hand may end: a URDF first, else it is an MJCF."""
_HANDS = {
    "icub_right": "icub_right_hand.urdf",
    "icub_left": "icub_left_hand.urdf",
    "planar_two_finger": "planar_two_finger.urdf",
    "yale_t42": "yale_t42.urdf",
}
_OBJECTS = (
    "toothpaste", "applier", "box", "weighted_box", "bottle", "can",
    "pen_case", "flashlight", "charger", "tea_tin", "jar", "carton",
)  # fmt: skip
_CYLINDERS = ("cylinder_20mm", "cylinder_30mm", "cylinder_35mm", "cylinder_45mm")


def urdf_folder() -> Path:
    """Where the URDF files are: inside an installed package, or in the repository of an editable one."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_urdf", package.parent / "urdf"):
        if (folder / "objects").is_dir():
            return folder
    raise DescriptionError(package, "the URDF files that belong to torch_ekm were not installed with it")


def list_hands() -> tuple[str, ...]:
    """The names of hands that :func:`load_hand` takes in place of a path."""
    return tuple(_HANDS)


def list_objects() -> tuple[str, ...]:
    """The everyday objects of the experiments; :func:`load_object` also takes the cylinders."""
    return _OBJECTS


def list_cylinders() -> tuple[str, ...]:
    """Cylinders by diameter, which :func:`load_object` takes: those that a Yale T42 was recorded with."""
    return _CYLINDERS


def load_hand(name: str | Path) -> HandDescription:
    """A hand by name, or from a path to a URDF with ``<stem>.transmission.toml`` next to it.

    An MJCF (``.xml`` or ``.mjcf``, extra ``mujoco``) says itself what transmits its motors; a transmission
    file next to it has the last word, and adds the pads.

    Raises:
        UnknownNameError: ``name`` is neither a known hand nor a path to a ``.urdf``, ``.xml`` or ``.mjcf``
            file.
        DescriptionError: a file is missing or wrong; the message names file and place.
        JointMismatchError: URDF and transmission file name different joints.
    """
    path, transmission = hand_paths(name)
    if path.suffix == ".urdf":
        return read_transmission(transmission, read_urdf(path))
    said = read_toml(transmission, "transmission file") if transmission.is_file() else {}
    hand, joints = said.get("hand"), said.get("joints")
    base = hand.get("base_link") if isinstance(hand, dict) else None
    mjcf = read_mjcf(path, base, joints if isinstance(joints, dict) else ())
    return read_transmission(transmission, mjcf.urdf, mjcf)


def load_object(name: str | Path) -> ObjectDescription:
    """An object by name, or from a path to a URDF with ``<stem>.object.toml`` next to it.

    Raises:
        UnknownNameError: ``name`` is neither a known object nor a path to a ``.urdf`` file.
        DescriptionError: a file is missing or wrong; the message names file and place.
    """
    urdf, about = object_paths(name)
    return read_object(about, read_urdf(urdf))


def hand_paths(name: str | Path) -> tuple[Path, Path]:
    """URDF or MJCF and transmission file of a hand, whether they exist or not.

    Raises:
        UnknownNameError: as :func:`load_hand`.
    """
    known = {key: urdf_folder() / file for key, file in _HANDS.items()}
    path = _resolve("hand", name, known, HAND_FILES)
    return path, path.with_suffix(".transmission.toml")


def object_paths(name: str | Path) -> tuple[Path, Path]:
    """URDF and object file of an object, whether they exist or not.

    Raises:
        UnknownNameError: as :func:`load_object`.
    """
    folder = urdf_folder() / "objects"
    known = {key: folder / f"{key}.urdf" for key in (*_OBJECTS, *_CYLINDERS)}
    path = _resolve("object", name, known, (".urdf",))
    return path, path.with_suffix(".object.toml")


def file_digests(hand: str | Path, objects: Iterable[str | Path]) -> dict[str, str]:
    """SHA-256 of each file that describes the hand and the objects (names or paths), hexadecimal.

    Returns:
        ``{"hand icub_right_hand.urdf": digest, ..., "object box.object.toml": digest}``

    Raises:
        UnknownNameError: no such hand or object.
        DescriptionError: a file cannot be read.
    """
    described, transmission = hand_paths(hand)
    files = [described, transmission]
    if described.suffix != ".urdf":  # which may be of several files, and say it all
        files = [*mjcf_files(described), *([transmission] if transmission.exists() else [])]
    named = [("hand", path) for path in files]
    named += [("object", path) for item in objects for path in object_paths(item)]
    contents = [(f"{kind} {path.name}", read_file(path, f"file of {kind}s", LARGEST)) for kind, path in named]
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents}


def _resolve(kind: str, name: str | Path, known: dict[str, Path], endings: tuple[str, ...]) -> Path:
    if isinstance(name, str) and name in known:
        return known[name]
    path = Path(name)
    if path.suffix == ".xacro":
        raise DescriptionError(path, f"run first: xacro {path} > {path.with_suffix('').with_suffix('.urdf')}")
    if path.suffix not in endings:
        raise UnknownNameError(kind, str(name), (*known, f"a path to a {' or '.join(endings)} file"))
    return path
