"""The recordings of a Yale T42 (Sintov et al.), read in place: who moved what, and what a camera saw."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from torch_ekm.exceptions import DescriptionError
from torch_ekm.typing import Array

FILE = "t42_hand/t42_testpaths.npz"
APART = "cyl45_d_v0"
"""The one object on which anything is identified; it is not reported."""
SKIPPED = ("str40_d_v1",)
"""A second recording of an object."""
UNIT = 0.97e-3
"""Motion of a motor in one step per unit of action [rad], from the settings of the recording's authors."""
STEP = 0.1  # [s]
_RED = "_red_"
_NOT_SEEN = 0.3  # [m]: what was not seen is written as a place a metre away


@dataclass(frozen=True)
class RecordedPath:
    """One path of one object, a row for each 0.1 s; camera axes."""

    pose: Array
    """Object x, y [m] and angle [rad], unwrapped ``(n, 3)``."""
    markers: Array
    """``(n, 4, 2)`` [m], NaN where not seen."""
    loads: Array
    """Of the two actuators, left and right, as the servos count ``(n, 2)``."""
    delta_a: Array
    """Motion of the left and the right motor in the step that follows ``(n, 2)`` [rad]."""

    def __len__(self) -> int:
        return len(self.pose)


def read_recordings(data: str | Path) -> dict[str, list[RecordedPath]]:
    """The paths of each object, in alphabetical order of the objects.

    Column 0 of the blue hand's actions is the right finger; of the red hand's (``_red_`` in the name) the
    left one, since its servos are numbered the other way round. The loads follow the actions.

    Args:
        data: ``t42_testpaths.npz``, or a folder that holds it (or ``t42_hand/``). Keys
            ``object/path/S`` ``(n, 13)``: object x, y [mm], angle [rad], four markers (proximal left, right,
            distal left, right) [m], two loads; and ``object/path/A`` ``(n, 2)`` or ``(n + 1, 2)``.

    Raises:
        DescriptionError: there is no such file, or its arrays are not of these shapes.
    """
    path = find_file(data)
    with _open(path) as file:
        keys = sorted(key[:-2] for key in file.files if key.endswith("/S"))
        if not keys:
            raise DescriptionError(path, "there is no array 'object/path/S' in it")
        found: dict[str, list[RecordedPath]] = {}
        for key in keys:
            name = key.rpartition("/")[0]
            if not name or f"{key}/A" not in file.files:
                raise DescriptionError(path, f"'{key}/S' needs a name 'object/path' and its '{key}/A'")
            states, actions = file[f"{key}/S"], file[f"{key}/A"]
            actions = actions[: len(states)]  # one more than states in most: what was asked for at the end
            if states.ndim != 2 or states.shape[1] != 13 or actions.shape != (len(states), 2):
                shapes = f"{states.shape} and {actions.shape}"
                raise DescriptionError(path, f"'{key}': S and A must be (n, 13) and (n, 2), got {shapes}")
            if name not in SKIPPED:
                found.setdefault(name, []).append(_path(states, actions, exchanged=_RED in name))
    return found


def find_file(data: str | Path) -> Path:
    """The file itself, from its path or from a folder.

    Raises:
        DescriptionError: it is not there.
    """
    data = Path(data)
    for path in (data, data / FILE, data / Path(FILE).name):
        if path.is_file():
            return path
    raise DescriptionError(
        data / Path(FILE).name, "there is no such file; 'torch-ekm compare --help' names its source (t42)"
    )


def _open(path: Path) -> Any:
    try:
        file = np.load(path)
    except (ValueError, EOFError, BadZipFile):
        file = None
    if not isinstance(file, np.lib.npyio.NpzFile):
        raise DescriptionError(path, "this is no .npz file, as numpy.savez writes it")
    return file


def _path(states: Array, actions: Array, *, exchanged: bool) -> RecordedPath:
    left_first = slice(None) if exchanged else slice(None, None, -1)
    markers = states[:, 3:11].reshape(-1, 4, 2).astype(np.float64)
    markers[np.linalg.norm(markers, axis=-1) > _NOT_SEEN] = np.nan
    pose = np.column_stack([1e-3 * states[:, :2], np.unwrap(states[:, 2])])
    return RecordedPath(pose, markers, states[:, 11:13][:, left_first], UNIT * actions[:, left_first])


def known_diameter(name: str) -> float | None:
    """Of an object ``cylNN...``: NN mm [m]; None: the shape is not published."""
    match = re.match(r"cyl(\d+)_", name)
    return None if match is None else float(match[1]) / 1000
