"""Recordings of ROS 1 and 2 (MCAP, sqlite3, .bag) as a table of numbers, without ROS (extra ``interop``)."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ..exceptions import DescriptionError, UnknownNameError
from ..typing import Array
from .bag_files import check_bag

Numbers = NDArray[np.integer[Any]]

AnyReader, _typesys = require("rosbags.highlevel").AnyReader, require("rosbags.typesys")

_MOST = 64  # numbers of one field; more is an image or a cloud
_LABELS = ("name", "joint_names", "interface_names")  # of a message, for the entries of its arrays
_LEFT_OUT = ("header", "layout", "structure_needs_at_least_one_member")  # stamps, array shapes
_HELD = 10  # mean intervals of a column that a value stands for; later the sensor is silent
_BACK, _STEPS = 0.1, 5  # [s], and in middle intervals: where stamps fall by more, a clock was set back
_EARLY, _LATE = -0.02, 1.0  # [s] from header.stamp to the log's time, where both are one clock's


class BagTable(NamedTuple):
    """A recording as numbers: one row for each moment, in the order of time within each run."""

    names: tuple[str, ...]
    """``/topic.field.joint`` or ``/topic.field[0]``, of each column."""
    time: Array
    """From the first row on, by the recording's clock [s] ``(n,)``; it goes back where a run begins."""
    values: Array
    """``(n, columns)``, in the messages' own units; NaN: not known at that time."""
    run: Numbers
    """Number of the run of each row ``(n,)``: another one begins where a clock was set back."""
    notes: tuple[str, ...] = ()
    """What was found of clocks and latencies."""


def read_bag(path: str | Path, clock: str, topics: Sequence[str] = ()) -> BagTable:
    """A recording as a table: a row for each message of ``clock``, with the newest values of other topics.

    Nothing that was measured later enters a row. A message counts from its ``header.stamp`` on, where that
    runs with the log's clock, at most 1 s before it; else from when it was logged. A value is NaN before its
    first message, where its array has got shorter, and once it is older than ten mean intervals of its
    column; one of a latched topic (transient local) holds until the next. Texts, headers and fields of more
    than 64 numbers are left out, and topics that cannot be read, unless they are asked for.

    Args:
        path: a folder of rosbag2, a single ``.mcap`` or ``.db3`` file, or a ``.bag`` of ROS 1.
        clock: the topic whose messages set the rows, such as that of the commands.
        topics: those that are read; all of them by default.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        DescriptionError: there is no such recording, it or a topic that is asked for cannot be read, or
            ``clock`` has no message.
        UnknownNameError: there is no such topic; the message lists them.
    """
    path = Path(path)
    check_bag(path)
    try:
        with AnyReader([path], default_typestore=_typesys.get_typestore(_typesys.Stores.LATEST)) as reader:
            there = sorted({connection.topic for connection in reader.connections})
            for topic in (clock, *topics):
                if topic not in there:
                    raise UnknownNameError("topic", topic, there)
            heard, left = _heard(reader, {clock, *(topics or there)})
    except (UnknownNameError, DescriptionError):
        raise
    except FileNotFoundError:
        problem = "a folder without metadata.yaml, as of a recorder that was killed: name the file in it"
        raise DescriptionError(path, f"no recording: {problem}, or run 'ros2 bag reindex'") from None
    except Exception as error:  # a damaged recording fails in any way that its format can think of
        raise DescriptionError(path, f"this recording cannot be read: {error}") from error
    for topic in (clock, *topics):
        if topic in left:
            raise DescriptionError(path, left[topic])
    if clock not in heard:
        raise DescriptionError(path, f"the topic '{clock}' has no message, and its messages set the rows")
    table = _table(clock, heard)
    return table._replace(notes=(*table.notes, *left.values()))


def _heard(reader: Any, wanted: set[str]) -> tuple[dict[str, _Topic], dict[str, str]]:
    """Topics, and why others cannot be read."""
    latched = {connection.topic for connection in reader.connections if _latched(connection.ext)}
    heard: dict[str, _Topic] = {}
    left: dict[str, str] = {}
    for place, (topic, kind, logged, raw) in enumerate(_written(reader, wanted)):
        if topic in left:
            continue
        one = heard.setdefault(topic, _Topic(topic, topic in latched))
        try:
            one.take(place, logged, reader.deserialize(raw, kind))
        except Exception as error:  # a type that nobody knows, a damaged message, a name twice
            left[topic] = f"{topic} ({kind}) cannot be read: {type(error).__name__}: {error}"
            del heard[topic]
    return heard, left


@dataclass
class _Topic:
    """What was heard of one topic, in the order of writing."""

    name: str
    latched: bool
    """A value is said once, for all who come later."""
    place: list[int] = field(default_factory=list)
    """In the file."""
    logged: list[int] = field(default_factory=list)
    """[ns]"""
    stamp: list[int] = field(default_factory=list)
    """``header.stamp`` [ns]; 0: none."""
    columns: dict[str, tuple[list[int], list[float]]] = field(default_factory=dict)
    """Numbers of the messages that say something of a column, and what; NaN: it is gone."""

    def take(self, place: int, logged: int, message: Any) -> None:
        number, found = len(self.place), dict(_numbers(message, self.name))
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        self.place.append(place)
        self.logged.append(logged)
        self.stamp.append(0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec)
        for name, value in found.items():
            at, values = self.columns.setdefault(name, ([], []))
            at.append(number)
            values.append(value)
        of = tuple(f".{label}" for label in _labels(message))  # other names may take turns
        for name, (at, values) in self.columns.items():
            gone = name not in found and not np.isnan(values[-1])
            if gone and ("[" in name or name.endswith(of)):
                at.append(number)
                values.append(np.nan)

    def fell(self) -> list[tuple[int, int]]:
        """Places in the file between which its clock was set back."""
        places: list[tuple[int, int]] = []
        for times, least in ((np.array(self.logged), 0.0), (np.array(self.stamp), 1e9 * _BACK)):
            step, lower = np.diff(times), np.pad(times[2:] < times[:-2], 1)
            stays = lower[:-1] & lower[1:]  # else one message was early or late
            back = min(least, _STEPS * np.median(np.abs(step))) if len(step) else 0.0
            fallen = np.flatnonzero((step < -back) & stays[: len(step)])
            if len(fallen) > max(1, len(times) // 20):  # clocks that take turns rise as they fall
                fallen = fallen[2 * np.maximum.reduceat(step, fallen) < -step[fallen]]
            places += [(self.place[k], self.place[k + 1]) for k in fallen]
        return places

    def measured(self, begin: int) -> tuple[Array, str]:
        """When each message counts [s from a time of the log on], and what is to be said of it."""
        logged, stamp = (1e-9 * (np.array(times) - begin) for times in (self.logged, self.stamp))
        stamped = np.array(self.stamp) != 0
        if len(set(self.stamp)) < len(stamp) / 2 or not stamped.any():  # none, or it stands
            return logged, ""
        late = (logged - stamp)[stamped]
        middle, most = float(np.median(late)), float(late.max())
        if np.mean((late > _EARLY) & (late < _LATE)) < 0.95:  # a network may hang for a moment
            return logged, f"{self.name} has a header.stamp {middle:.4g} s before it was logged: not used"
        said = f"{self.name} counts from its header.stamp, {1e3 * middle:.3g} ms before it was logged"
        known = f"{said} (at most {1e3 * most:.3g} ms)" if most >= 1e-3 else ""
        return np.where(stamped, stamp, logged), known


def _table(clock: str, heard: dict[str, _Topic]) -> BagTable:
    starts: list[int] = []  # in the file, of all runs but the first
    for after, place in sorted((fall for one in heard.values() for fall in one.fell()), key=lambda x: x[1]):
        if not starts or starts[-1] <= after:  # else it is the one that another topic has shown
            starts.append(place)
    order, notes = [clock, *(name for name in heard if name != clock)], []
    when = {name: heard[name].measured(heard[clock].logged[0]) for name in order}
    run = {name: np.searchsorted(starts, heard[name].place, side="right") for name in order}
    rows = np.lexsort((when[clock][0], run[clock]))
    time, runs = when[clock][0][rows], run[clock][rows]
    row_of = np.argsort(rows)  # rows of one time each have their own message
    if starts:
        notes.append(f"{len(np.unique(runs))} runs: a clock was set back")
    notes += [said for _, said in when.values() if said]
    names, values = [], []
    for topic in order:
        for name, (at, given) in heard[topic].columns.items():
            taken, order = when[topic][0][at], (np.arange(len(rows)), row_of[at]) if topic == clock else None
            held = np.inf if heard[topic].latched else _HELD
            values.append(_held(time, runs, taken, run[topic][at], np.array(given), order, held))
            names.append(name)
    _, number = np.unique(runs, return_inverse=True)
    values = np.reshape(values, (len(names), len(time))).T
    return BagTable(tuple(names), time - time[0], values, number, tuple(notes))


def _held(
    time: Array,
    runs: Numbers,
    at: Array,
    run: Numbers,
    given: Array,
    places: tuple[Numbers, Numbers] | None,
    held: float,
) -> Array:
    """Of each row the newest value of its run, by times or by ``places`` of rows and values.

    NaN: there is none, or it is older than ``held`` mean intervals.
    """
    key, place = (time, at) if places is None else places
    order = np.lexsort((place, run))
    at, place, run, given = at[order], place[order], run[order], given[order]
    steps = np.diff(at)[np.diff(run) == 0]
    most = held * max(steps.mean(), 1e-9) if len(steps) > 1 else np.inf
    value = np.full(len(time), np.nan)
    for one in np.unique(run):
        mine, rows = run == one, np.flatnonzero(runs == one)
        last = np.searchsorted(place[mine], key[rows], side="right") - 1
        known = last >= 0
        rows, last = rows[known], last[known]
        value[rows] = np.where(time[rows] - at[mine][last] <= most, given[mine][last], np.nan)
    return value


def _latched(ext: Any) -> bool:
    """By the header of a connection of ROS 1, or the quality of ROS 2."""
    offered = getattr(ext, "offered_qos_profiles", ())
    return bool(getattr(ext, "latching", 0)) or any(x.durability.name == "TRANSIENT_LOCAL" for x in offered)


def _written(reader: Any, topics: set[str]) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, time of the log [ns] and bytes, in the order of writing: only there a clock goes back.

    Where the storage has no order, in that of time.
    """
    for bag in reader.readers:
        storage = getattr(bag, "storage", None)
        packed = getattr(getattr(storage, "metadata", None), "compression_mode", None) == "message"
        for part in [bag] if packed else getattr(storage, "storages", [storage or bag]):
            wanted = [one for one in part.connections if one.topic in topics]
            if not wanted:
                continue
            if hasattr(part, "messages_scan"):
                found = part.messages_scan(wanted)
            elif getattr(part, "dbconn", None) is not None:
                found = _rows(part, wanted)
            elif hasattr(part, "indexes"):
                found = _by_place(part, wanted)
            else:
                found = part.messages(wanted)
            for connection, logged, raw in found:
                yield connection.topic, connection.msgtype, logged, raw


def _rows(database: Any, wanted: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Of rosbag2's sqlite3."""
    by_id, ask = {one.id: one for one in wanted}, "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
    for topic, logged, raw in database.dbconn.cursor().execute(ask):
        if topic in by_id:
            yield by_id[topic], logged, raw


def _by_place(bag: Any, wanted: list[Any]) -> list[tuple[Any, int, bytes]]:
    """Of a bag of ROS 1, which gives messages in the order of its index."""
    index = heapq.merge(*(bag.indexes[one.id] for one in wanted))
    pairs = zip(index, bag.messages(wanted), strict=True)
    return [message for _, message in sorted(pairs, key=lambda one: (one[0].chunk_pos, one[0].offset))]


def _labels(message: Any) -> list[str]:
    """Names that a message has for the entries of its arrays."""
    for key in _LABELS:
        given = getattr(message, key, None)
        if isinstance(given, list) and given and all(isinstance(one, str) for one in given):
            return given
    return []


def _numbers(value: Any, place: str, labels: Sequence[str] = ()) -> Iterator[tuple[str, float]]:
    """The numbers of a message, by name; names that it has stand for indices, also in what it contains.

    Raises:
        DescriptionError: a name stands in it twice.
    """
    if is_dataclass(value):
        labels = _labels(value) or labels
        if twice := [one for one in dict.fromkeys(labels) if labels.count(one) > 1]:
            raise DescriptionError(place, f"a message has the name '{twice[0]}' twice")
        for one in fields(value):
            if one.name not in _LEFT_OUT and not one.name.startswith("__"):
                yield from _numbers(getattr(value, one.name), f"{place}.{one.name}", labels)
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        yield place, float(value)
    elif isinstance(value, list | np.ndarray) and len(value) <= _MOST:
        # transforms take turns on one topic
        frames = [getattr(one, "child_frame_id", "") for one in value if isinstance(value, list)]
        names = frames if all(frames) and 0 < len(set(frames)) == len(value) else labels
        named = len(value) == len(names) > 0 and not isinstance(value[0], str)
        places = [f".{name}" for name in names] if named else [f"[{i}]" for i in range(len(value))]
        for at, one in zip(places, value, strict=True):
            yield from _numbers(one, f"{place}{at}", () if named else labels)
