"""One trial as it was: commands, readings, truth; its file; plants that write it down, and play it again."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from .._extras import require
from .._files import check_announced, opened, told_as_damage, write_whole
from ..exceptions import DescriptionError, ParameterError, StateError
from ..typing import Float, Tensor
from .plant import Observation, Plant, PlantStatus, PlantWrapper, Stamps, Truth, can_follow
from .plant import Path as Waypoints

FORMAT = "torch_ekm trial 2"
_LARGEST = 4 << 30  # bytes
_KINDS = "biufS"
_HEAD = 512  # bytes: the block that HDF5 leaves to its user (its smallest size)
_LINE = re.compile(f"{FORMAT}\nsha256 ([0-9a-f]{{64}})\n".encode())


def write_trial(path: Path, seed: int, about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write an HDF5 file, whole or not at all; equal contents give equal files, byte by byte.

    The file is made in memory: HDF5 itself crashes the process on a full disk.

    Raises:
        OutputError: it cannot be written.
    """
    memory = io.BytesIO()
    with require("h5py").File(memory, "w", libver=("v110", "v110"), userblock_size=_HEAD) as file:
        file.attrs["format"], file.attrs["seed"], file.attrs["about"] = FORMAT, seed, json.dumps(about)
        for name, value in arrays.items():
            packed = {"compression": "gzip"} if value.size else {}
            file.create_dataset(name, data=value, track_times=False, **packed)
    content = bytearray(memory.getvalue())
    content[:_HEAD] = _head("0" * 64)
    content[:_HEAD] = _head(hashlib.sha256(content).hexdigest())
    write_whole(path, bytes(content))


def read_trial(
    path: Path, wanted: Callable[[str], bool] = lambda place: True
) -> tuple[int, dict[str, Any], dict[str, np.ndarray]]:
    """Seed, ``about`` and the arrays whose places are wanted, of a file whose bytes are those written.

    Raises:
        DescriptionError: no such file, no recording, or a damaged one.
    """
    with opened(path, "recording", _LARGEST) as content:
        head = _LINE.match(first := content.read(_HEAD))
        if head is None:
            problem = f"a recording starts with a line '{FORMAT}', which this file does not"
            raise DescriptionError(
                path, f"damaged, or not a recording of this version of torch_ekm: {problem}"
            )
        digest = hashlib.sha256(_head("0" * 64))
        hashlib.file_digest(content, lambda: digest)
        if first != _head(head[1].decode()) or digest.hexdigest() != head[1].decode():
            raise DescriptionError(path, "damaged: its bytes are not those that were written (SHA-256)")
        h5py, arrays = require("h5py"), {}
        with told_as_damage(path, "recording"), h5py.File(content, "r") as file:

            def take(place: str, item: Any) -> None:
                if not isinstance(item, h5py.Dataset) or not wanted(place):
                    return
                if item.external or item.is_virtual:
                    raise DescriptionError(path, f"'{place}' lies in another file")
                if item.dtype.kind not in _KINDS:  # of other kinds a byte there may stand for any number
                    raise DescriptionError(path, f"'{place}' holds {item.dtype}, no figures")
                announced = sum(array.nbytes for array in arrays.values()) + item.nbytes
                check_announced(path, announced, path.stat().st_size)
                arrays[place] = item[()]

            file.visititems(take)
            seed, about = int(file.attrs["seed"]), json.loads(file.attrs["about"])
            if not isinstance(about, dict):
                raise DescriptionError(path, "damaged recording: what it says about itself is no table")
            return seed, about, arrays


def _head(digest: str) -> bytes:
    return f"{FORMAT}\nsha256 {digest}\n".encode().ljust(_HEAD, b"\0")


_FIELDS = ("q", "a", "position", "rotation")
_FORCE = "fingertip_force"  # missing where nothing measures it
_PATHS, _PASSED = "paths", "passed"  # groups: of followed movements what was sent, and readings on the way
_GROUPS = ("raw", "estimate")  # what is kept of Observation.info, and "events"


class Movement(NamedTuple):
    """A path that was followed, and the readings on the way."""

    path: Waypoints
    passed: list[Observation]


@dataclass
class Trajectory:
    """Commands and observations of one grasp: ``n`` commands, ``n + 1`` observations.

    A path that was followed counts as the command of its last waypoint.

    It also keeps of ``Observation.info`` the named arrays in "raw" (Hall counts, marker corners, images) and
    "estimate" (what else was estimated, such as covariances), and what is in "events", as text.
    """

    seed: int = 0
    commands: list[Tensor] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)
    """Anything else that JSON can hold: configuration, versions, outcome. No times of day: equal runs
    are to give equal files."""
    movements: dict[int, Movement] = field(default_factory=dict)
    """Commands that were paths, by their number."""

    def save(self, path: str | Path) -> Path:
        """Write an HDF5 file, whole or not at all; equal recordings give equal files, byte by byte.

        ``commands (n, n_a)`` [rad], each sensor ``(n + 1, ...)`` [SI], groups ``truth``, ``raw`` and
        ``estimate``; a SHA-256 of all its bytes. Without fingertip sensors there is no ``fingertip_force``.
        Of m followed waypoints ``paths/waypoints (m, n_a)``, ``paths/times (m,)`` and ``paths/command (m,)``,
        the number of the command; in the group ``passed`` the same for the readings on the way.

        Raises:
            ParameterError: ``about`` is nothing that JSON can hold, or the forces or an array of ``info``
                change their shape; nothing is written.
            StateError: they come and go; nothing is written.
            OutputError: the file cannot be written.
        """
        path = Path(path)
        write_trial(path, self.seed, plain(self.about), self.arrays() | self._of_movements())
        return path

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read what :meth:`save` wrote.

        Raises:
            DescriptionError: no such file, not a recording, or a damaged one.
        """
        path = Path(path)
        seed, about, arrays = read_trial(path)
        with told_as_damage(path, "recording"):  # its digest is right and its contents are not: nobody's
            return cls.from_arrays(seed, about, arrays)

    @classmethod
    def from_arrays(cls, seed: int, about: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> Trajectory:
        """What is in a file, or what :meth:`arrays` gave, as a trajectory again.

        Raises:
            KeyError: an array is missing.
        """
        movements = _movements(arrays)
        own = (_PATHS, _PASSED)
        arrays = {place: v for place, v in arrays.items() if place.partition("/")[0] not in own}
        names = (*_FIELDS, "commands", *((_FORCE,) if _FORCE in arrays else ()))
        sensors = {name: torch.from_numpy(arrays[name]) for name in names}
        stamps = arrays.get("stamps")
        times, words, events = (arrays[name].tolist() for name in ("time", "status", "events"))
        groups: dict[str, dict[str, Tensor]] = {}
        for place, value in arrays.items():
            group, _, name = place.partition("/")
            if name:
                groups.setdefault(group, {})[name] = torch.from_numpy(value)
        commands, truth = list(sensors.pop("commands")), groups.pop("truth", None)
        observations = []
        for k, time in enumerate(times):
            info: dict[str, Any] = {group: _row(values, k) for group, values in groups.items()}
            if happened := json.loads(events[k]):
                info["events"] = tuple(happened)
            known = None if truth is None else Truth(**_row(truth, k))
            taken = None if stamps is None else Stamps(*stamps[k].tolist())
            other = {"status": PlantStatus(words[k].decode()), "info": info, "truth": known, "stamps": taken}
            observations.append(Observation(**_row(sensors, k), time=time, **other))
        return cls(seed, commands, observations, about, movements)

    def arrays(self) -> dict[str, np.ndarray]:
        """Commands, and a row for each observation, by their places in the file; see :meth:`from_arrays`.

        Raises:
            ParameterError: the forces or an array of ``info`` change their shape.
            StateError: they come and go.
        """
        seen = self.observations
        events = [json.dumps([str(event) for event in o.info.get("events", ())]).encode() for o in seen]
        arrays = {
            "commands": _stack("commands", self.commands),
            "time": np.array([o.time for o in seen], dtype=np.float64),
            "status": np.array([o.status.value for o in seen], dtype="S8"),
            "events": np.array(events, dtype=bytes),
        }
        arrays |= {name: _stack(name, [getattr(o, name) for o in seen]) for name in _FIELDS}
        if any(o.stamps is not None for o in seen):
            arrays["stamps"] = np.array([o.taken for o in seen], dtype=np.float64)
        for group in ("", "truth", *_GROUPS):
            named = [o.info.get(group, {}) for o in seen]
            if group == "":
                named = [{} if o.fingertip_force is None else {_FORCE: o.fingertip_force} for o in seen]
            elif group == "truth":
                named = [{} if o.truth is None else o.truth.arrays() for o in seen]
            for name in sorted({name for values in named for name in values}):
                place = f"{group}/{name}" if group else name
                if not all(name in values for values in named):
                    raise StateError(
                        f"{place} is missing in some observations; it must be in all, or in none"
                    )
                arrays[place] = _stack(place, [values[name] for values in named])
        return arrays

    def _of_movements(self) -> dict[str, np.ndarray]:
        """What :func:`_movements` reads."""
        if not self.movements:
            return {}
        moved = sorted(self.movements.items())
        paths = [one.path for _, one in moved]
        arrays = {
            f"{_PATHS}/command": np.repeat([k for k, _ in moved], [len(path.times) for path in paths]),
            f"{_PATHS}/waypoints": torch.cat([path.waypoints for path in paths]).numpy(),
            f"{_PATHS}/times": torch.cat([path.times for path in paths]).numpy(),
        }
        passed = Trajectory(observations=[seen for _, one in moved for seen in one.passed])
        if passed.observations:
            of = [k for k, one in moved for _ in one.passed]
            there = {**passed.arrays(), "command": np.array(of)}
            arrays |= {f"{_PASSED}/{place}": v for place, v in there.items() if place != "commands"}
        return arrays


def _movements(arrays: Mapping[str, np.ndarray]) -> dict[int, Movement]:
    """The followed movements, by the numbers of their commands; a file of before has none."""
    if f"{_PATHS}/command" not in arrays:
        return {}
    of, w, t = (arrays[f"{_PATHS}/{name}"] for name in ("command", "waypoints", "times"))
    found = {
        int(k): Movement(Waypoints(torch.from_numpy(w[of == k]), torch.from_numpy(t[of == k])), [])
        for k in np.unique(of)
    }
    there = {p.partition("/")[2]: value for p, value in arrays.items() if p.startswith(f"{_PASSED}/")}
    if there:
        numbers = there.pop("command").tolist()
        passed = Trajectory.from_arrays(0, {}, {**there, "commands": np.zeros(0)}).observations
        for k, seen in zip(numbers, passed, strict=True):
            found[k].passed.append(seen)
    return found


def _row(arrays: Mapping[str, Tensor], k: int) -> dict[str, Any]:
    """Those of one observation."""
    return {name: value[k] for name, value in arrays.items()}


def _stack(name: str, values: list[Any]) -> np.ndarray:
    """``(len(values), ...)``"""
    arrays = [np.asarray(torch.as_tensor(value).detach().cpu()) for value in values]
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise ParameterError(name, sorted(shapes), "of one shape in all observations of a trial")
    return np.stack(arrays) if arrays else np.zeros(0)


def plain(value: Any) -> Any:
    """``value`` as it comes back from JSON, mappings in the order of their keys.

    Raises:
        ParameterError: JSON cannot hold it.
    """
    try:
        return json.loads(json.dumps(value, sort_keys=True, default=_as_plain))
    except TypeError as error:
        raise ParameterError("about", error, "figures, texts, lists and mappings of those") from None


def _as_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__}")


class RecordingPlant(PlantWrapper):
    """Passes everything on to a plant and remembers it in ``trajectory``, which outlives the plant.

    With a :class:`~torch_ekm.plant.TrialLog` each trial is kept::

        log = TrialLog("log", configuration)
        for trial in log.missing(range(1000)):
            plant.reset(trial)
            ...
            log.write(trial, plant.trajectory)
    """

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.trajectory = Trajectory()

    def reset(self, seed: int) -> Observation:
        """Grasp again, and start a new trajectory, which stays empty if there is no grasp."""
        self.trajectory = Trajectory(seed)
        observation = self.plant.reset(seed)
        self.trajectory.observations.append(observation)
        return observation

    def observe(self) -> Observation:
        """Read the sensors; recorded in the place of the last reading, since the hand has not moved."""
        observation = self.plant.observe()
        known = self.trajectory.observations
        before = known[-1].info if known else {}  # a plant may have held the object before it was recorded
        if "events" in before:
            info = {**observation.info, "events": before["events"]}
            observation = dataclasses.replace(observation, info=info)
        known[-1:] = [observation]
        return observation

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """Pass the increment [rad] on; it and the observation after it are recorded."""
        if not self.trajectory.observations:
            self.observe()
        return self._kept(delta_a, self.plant.command(delta_a))

    def _followed(self, path: Waypoints, watch: Callable[[Observation], bool]) -> Observation:
        """Pass the path on; it, the readings on the way and the observation after it are recorded."""
        if not self.trajectory.observations:
            self.observe()
        assert can_follow(self.plant)
        passed: list[Observation] = []
        observation = self.plant.follow(path, lambda seen: passed.append(seen) or watch(seen))
        self.trajectory.movements[len(self.trajectory.commands)] = Movement(path, passed)
        return self._kept(path.waypoints[-1], observation)

    def _kept(self, delta_a: Float[Tensor, " n_a"], observation: Observation) -> Observation:
        self.trajectory.commands.append(torch.as_tensor(delta_a).detach().cpu().double().clone())
        self.trajectory.observations.append(observation)
        return observation


class ReplayedPlant:
    """Gives the recorded observations one by one, independent of the commands; implements :class:`Plant`.

    A driver of a real hand has the same methods: send the increment, wait until it is done, read the sensors.

    Raises:
        StateError: the trajectory is empty.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if not trajectory.observations:
            raise StateError("the trajectory is empty: it has no observation to begin with")
        self.trajectory = trajectory
        self._place = 0

    def reset(self, seed: int = 0) -> Observation:
        """Back to the first observation; the seed plays no part."""
        self._place = 0
        return self.observe()

    def observe(self) -> Observation:
        """The recorded observation after the last replayed command."""
        return self.trajectory.observations[self._place]

    def command(self, delta_a: Float[Tensor, " n_a"]) -> Observation:
        """The next observation.

        Raises:
            StateError: the trajectory ends here.
        """
        if self._place >= len(self.trajectory.commands):
            raise StateError(f"the recording ends after {self._place} commands; reset() begins again")
        self._place += 1
        return self.observe()

    def follow(self, path: Waypoints, watch: Callable[[Observation], bool]) -> Observation:
        """The next observation, after the recorded readings on the way, if it was a movement.

        Raises:
            StateError: the trajectory ends here.
        """
        movement = self.trajectory.movements.get(self._place)
        after = self.command(path.waypoints[-1])
        for seen in movement.passed if movement else ():
            if not watch(seen):
                break
        return after

    def close(self) -> None:
        """Does nothing: a recording holds no device."""
