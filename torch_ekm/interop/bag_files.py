"""What the files of a recording must be before a library unpacks them."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import struct
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

from .._files import check_announced, check_file, opened, told_as_damage
from ..exceptions import DescriptionError

_LARGEST, _LARGEST_LIST = 16 << 30, 1 << 20  # bytes, of a recording and of the list of a folder's contents
_FIRST = {".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0\n"}


def check_bag(path: Path) -> None:
    """That each file of a recording is one of its kind, and no part of it announces more than it can hold.

    Raises:
        DescriptionError: there is none, it begins otherwise, a database has more than tables, or a chunk
            unpacks to more than 64 MiB and 32 times its size.
    """
    for file in sorted(path.iterdir()) if os.path.isdir(path) else [path]:
        kind = file.suffix.lower()
        check_file(file, "recording", _LARGEST_LIST if kind == ".yaml" else _LARGEST)
        if kind not in _FIRST:
            continue
        with opened(file, "recording", _LARGEST) as content, told_as_damage(file, "recording"):
            if content.read(len(_FIRST[kind])) != _FIRST[kind]:
                raise DescriptionError(
                    file, f"this recording cannot be read: it does not begin as a '{kind}' does"
                )
            if kind == ".db3":
                _check_database(file)
            for announced, there in _chunks(content, kind):
                check_announced(file, announced, there)


def _check_database(path: Path) -> None:
    """A view could go on without end."""
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        other = database.execute(
            "SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index')"
        ).fetchone()
    if other is not None:
        raise DescriptionError(path, f"the database has more than tables: '{other[0]}'")


def _chunks(file: BufferedReader, kind: str) -> Iterator[tuple[int, int]]:
    """What each chunk says that it unpacks to, and its own size."""
    while kind == ".mcap" and len(head := file.read(9)) == 9:
        code, size = struct.unpack("<BQ", head)
        end = file.tell() + size
        if code == 6:
            yield struct.unpack("<16xQ", file.read(24))[0], size
        file.seek(end)
    while kind == ".bag" and len(head := file.read(4)) == 4:
        fields = file.read(min(*struct.unpack("<I", head), 1 << 16))
        (size,) = struct.unpack("<I", file.read(4))
        _, is_there, unpacked = fields.partition(b"\x09\0\0\0size=")
        if is_there and b"op=\x05" in fields:
            yield struct.unpack("<I", unpacked[:4])[0], size
        file.seek(size, 1)
