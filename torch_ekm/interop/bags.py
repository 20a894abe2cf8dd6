"""Recordings of ROS 1 and 2 (MCAP, sqlite3, .bag) as a table of numbers, without ROS (extra ``interop``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._extras import require
from ..exceptions import DescriptionError, UnknownNameError
from ..typing import Array
from .bag_files import check_bag

AnyReader, _typesys = require("rosbags.highlevel").AnyReader, require("rosbags.typesys")

_MOST = 64  # numbers of one field; more is an image or a cloud
_LEFT_OUT = ("header", "layout")  # stamps and array shapes


class BagTable(NamedTuple):
    """A recording as numbers: one row for each moment, in the order of time."""

    names: tuple[str, ...]
    """``/topic.field.joint`` or ``/topic.field[0]``, of each column."""
    time: Array
    """Of the recording's clock, from its first row on [s] ``(n,)``."""
    values: Array
    """``(n, columns)``, in the messages' own units."""


def read_bag(path: str | Path, clock: str, topics: Sequence[str] = ()) -> BagTable:
    """A recording as a table: a row for each message of ``clock``, with the last message of each other topic.

    Nothing of the future enters a row. Rows before every topic had its first message are left out, and so are
    texts, headers and fields of more than 64 numbers.

    Args:
        path: a folder of rosbag2, a single ``.mcap`` or ``.db3`` file, or a ``.bag`` of ROS 1.
        clock: the topic whose messages set the rows, such as that of the commands.
        topics: those that are read; all of them by default.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        DescriptionError: there is no such recording, it cannot be read, or no row is complete.
        UnknownNameError: there is no such topic; the message lists them.
    """
    path = Path(path)
    check_bag(path)
    heard: dict[str, float] = {}
    rows: list[tuple[int, dict[str, float]]] = []
    try:
        reader = AnyReader([path], default_typestore=_typesys.get_typestore(_typesys.Stores.LATEST))
        with reader:
            there = sorted({connection.topic for connection in reader.connections})
            for topic in (clock, *topics):
                if topic not in there:
                    raise UnknownNameError("topic", topic, there)
            wanted = {clock, *(topics or there)}
            connections = [one for one in reader.connections if one.topic in wanted]
            due: int | None = None  # messages of one moment belong together, whichever comes first
            for connection, stamp, raw in reader.messages(connections=connections):
                if due is not None and stamp > due:
                    rows.append((due, dict(heard)))
                    due = None
                message = reader.deserialize(raw, connection.msgtype)
                heard.update(_numbers(message, connection.topic))
                if connection.topic == clock:
                    due = stamp
            if due is not None:
                rows.append((due, dict(heard)))
    except UnknownNameError:
        raise
    except FileNotFoundError:
        raise DescriptionError(path, "there is no such recording") from None
    except Exception as error:  # a damaged recording fails in any way that its format can think of
        raise DescriptionError(path, f"this recording cannot be read: {error}") from error
    complete = [(stamp, row) for stamp, row in rows if len(row) == len(heard)]
    if not complete:
        raise DescriptionError(
            path, f"no message of '{clock}' comes after the first message of every other topic"
        )
    first = complete[0][0]
    time = np.array([1e-9 * (stamp - first) for stamp, _ in complete])
    return BagTable(tuple(heard), time, np.array([[row[name] for name in heard] for _, row in complete]))


def _numbers(value: Any, place: str) -> Iterator[tuple[str, float]]:
    """The numbers of a message, by name; joint names stand for indices where a message has them."""
    if is_dataclass(value):
        given = getattr(value, "name", None)
        labels = given if isinstance(given, list) else []
        for field in fields(value):
            part = getattr(value, field.name)
            if field.name in _LEFT_OUT or field.name.startswith("__"):
                continue
            if labels and isinstance(part, np.ndarray) and len(part) == len(labels):
                for label, one in zip(labels, part, strict=True):
                    yield f"{place}.{field.name}.{label}", float(one)
            else:
                yield from _numbers(part, f"{place}.{field.name}")
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        yield place, float(value)
    elif isinstance(value, list | np.ndarray) and len(value) <= _MOST:
        for i, one in enumerate(value):
            yield from _numbers(one, f"{place}[{i}]")
