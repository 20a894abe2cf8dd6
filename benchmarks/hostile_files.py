"""Files that are damaged, or made to do harm: each is read, or refused by an error of torch_ekm, at once.

    python benchmarks/hostile_files.py

Six hundred files of sixteen kinds: learners, knowledge, trials, logs, CSV, Parquet, recordings of ROS,
hands, objects, wirings. A quarter is made by hand: pipes, devices, folders, sparse files of 8 GB, headers
that announce more than there is, endless fields, lines and queries, other encodings. The rest are good files
with bytes that were changed, cut out, doubled or swapped; most trials with a digest that is right for them.
A process reads them one after the other; one that ends or hangs is counted, and started again.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import sqlite3
import struct
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import h5py
import numpy as np
import pyarrow
import torch
from pyarrow import parquet
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from torch_ekm import SparseOnlineGP, load, save
from torch_ekm.control import HandKnowledge
from torch_ekm.description import load_hand, load_object
from torch_ekm.description.registry import hand_paths, object_paths
from torch_ekm.drivers.wiring import Wiring
from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.learner_comparison.stream import load_table
from torch_ekm.interop import read_bag
from torch_ekm.plant import Observation, Trajectory, TrialLog, verify_log
from torch_ekm.plant.trajectory import FORMAT

_ARRAY = "std_msgs/msg/Float64MultiArray"
SLOWEST, LARGEST = 10.0, 1 << 30  # [s], bytes
Make = Callable[[Path], object]


class Kind(NamedTuple):
    """Files of one kind."""

    name: str
    """Of the file that is changed."""
    write: Make
    """A good one, and what belongs to it, into a folder."""
    read: Callable[[Path], object]
    made: Mapping[str, Make] = MappingProxyType({})
    """Bad ones that are made by hand, by what they are."""


# -- good files -------------------------------------------------------------------------------


def _learner(path: Path) -> None:
    learner = SparseOnlineGP(2, 1, capacity=8)
    learner.update(torch.rand(20, 2, generator=_torch()), torch.rand(20, 1, generator=_torch()))
    save(learner, path)


def _trajectory() -> Trajectory:
    rows, eye = torch.rand(20, 4, generator=_torch(), dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    seen = [Observation(row, row[:2], row[:3], eye, row[:2], 0.1 * k) for k, row in enumerate(rows)]
    return Trajectory(0, [row[:2] for row in rows[1:]], seen)


def _log(path: Path) -> None:
    with TrialLog(path.parent, {"hand": "planar_two_finger", "object": "cylinder_30mm"}) as log:
        for trial in range(2):
            log.write(trial, _trajectory(), {"reason": "reached"})


def _rows() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(60, 3))


def _csv(path: Path) -> None:
    np.savetxt(path, _rows(), delimiter=",", header="a,b,y", comments="")


def _parquet(path: Path, **options: Any) -> None:
    parquet.write_table(pyarrow.table(dict(zip("aby", _rows().T, strict=True))), path, **options)


def _bag(path: Path, plugin: StoragePlugin) -> None:
    """One file of a recording of ROS 2."""
    _folder(path.parent / "bag" / "metadata.yaml", plugin)
    (found,) = (path.parent / "bag").glob(f"*{path.suffix}")
    found.rename(path)


def _folder(path: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> None:
    """A recording of ROS 2, whose list of contents is the file."""
    with contextlib.suppress(OSError):
        path.parent.rmdir()
    with Writer(path.parent, version=9, storage_plugin=plugin) as writer:
        store = get_typestore(Stores.LATEST)
        topic = writer.add_connection("/u", _ARRAY, typestore=store)
        for time, message in _messages(store):
            writer.write(topic, time, store.serialize_cdr(message, _ARRAY))


def _bag_of_ros_1(path: Path) -> None:
    with Writer1(path) as writer:
        store = get_typestore(Stores.ROS1_NOETIC)
        topic = writer.add_connection("/u", _ARRAY, typestore=store)
        for time, message in _messages(store):
            writer.write(topic, time, store.serialize_ros1(message, _ARRAY))


def _messages(store: Typestore) -> Iterator[tuple[int, object]]:
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    for k, row in enumerate(_rows()):
        yield 10**9 + 10**7 * k, store.types[_ARRAY](layout, row)


def _hand(path: Path) -> None:
    for source in hand_paths("planar_two_finger"):
        shutil.copy(source, path.with_name("hand" + "".join(source.suffixes)))


def _object(path: Path) -> None:
    for source in object_paths("cylinder_30mm"):
        shutil.copy(source, path.with_name("thing" + "".join(source.suffixes)))


def _mjcf(path: Path) -> None:
    finger = (
        '<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0" range="0 1" limited="true"/>'
        '<inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/></body>'
    )
    motor = '<position name="{0}" joint="{0}" kp="4" ctrlrange="0 1"/>'
    bodies, motors = (
        "".join(text.format(name, x) for name, x in (("left", -1), ("right", 1))) for text in (finger, motor)
    )
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body name="palm"><inertial mass="1" pos="0 0 0" '
        f'diaginertia="1e-3 1e-3 1e-3"/>{bodies}</body></worldbody><actuator>{motors}</actuator></mujoco>'
    )


def _wiring(path: Path) -> None:
    path.write_text(
        '[hand]\ndriver = "ros2"\ndescription = "planar_two_finger"\n[bus]\ncommand = "/go"\n'
        '[[motors]]\nname = "left"\n[[motors]]\nname = "right"\n[limits]\nincrement_deg = 20\n'
    )


def _knowledge(path: Path) -> None:
    HandKnowledge.of(load_hand("planar_two_finger")).save(path)


def _read_bag(path: Path) -> object:
    return read_bag(path, "/u")


def _read_wiring(path: Path) -> object:
    return Wiring.read(path, "ros2", 1.0, ("command",), named=True)


def _torch() -> torch.Generator:
    return torch.Generator().manual_seed(0)


# -- files made to do harm --------------------------------------------------------------------


def _announcing(path: Path, capacity: int = 100_000, shape: tuple[int, ...] = ()) -> None:
    """A learner whose header asks for more than the file has."""
    _learner(path)
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(entries["header.json"])
    if shape:
        claim = io.BytesIO()
        np.lib.format.write_array_header_1_0(claim, {"descr": "<f8", "fortran_order": False, "shape": shape})
        entries["0.npy"] = claim.getvalue() + bytes(8)
    else:
        header["made_with"]["arguments"]["capacity"] = capacity
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**entries, "header.json": json.dumps(header).encode()}.items():
            archive.writestr(name, content)


def _deep(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.json", "[" * 100_000 + "]" * 100_000)


def _deflated(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.json", '{"format": "torch_ekm learner 1"}')
        archive.writestr("0.npy", bytes(1 << 28))


def _overlapping(path: Path) -> None:
    """A thousand names for the same bytes."""
    _learner(path)
    with zipfile.ZipFile(path, "a") as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
        for k in range(1000):
            entry = zipfile.ZipInfo(f"{k + 100}.npy")
            entry.header_offset, entry.CRC = largest.header_offset, largest.CRC
            entry.file_size = entry.compress_size = largest.file_size
            archive.filelist.append(entry)
        archive._didModify = True  # pyright: ignore[reportAttributeAccessIssue]


def _trial(fill: Callable[[h5py.File], object]) -> Make:
    """A trial with a right digest, and what ``fill`` puts into it."""

    def write(path: Path) -> None:
        with h5py.File(path, "w", userblock_size=512) as file:
            file.attrs["format"], file.attrs["seed"], file.attrs["about"] = FORMAT, 0, "{}"
            fill(file)
        path.write_bytes(signed(path.read_bytes()))

    return write


def signed(content: bytes) -> bytes:
    """A trial's bytes with the digest that is right for them."""

    def head(digest: str) -> bytes:
        return f"{FORMAT}\nsha256 {digest}\n".encode().ljust(512, b"\0")

    digest = hashlib.sha256(head("0" * 64) + content[512:]).hexdigest()
    return head(digest) + content[512:]


def _same_text(file: h5py.File) -> None:
    """A million rows that are one and the same text of a megabyte."""
    kind = h5py.string_dtype()
    rows = file.create_dataset("q", (1_000_000,), dtype=kind, chunks=(1000,), fillvalue="x" * 60_000)
    rows[0] = "x" * 1_000_000


def _constant_rows(path: Path) -> None:
    column = pyarrow.array(np.zeros(20_000_000))
    parquet.write_table(pyarrow.table({"a": column, "b": column, "y": column}), path)


def _wide(path: Path) -> None:
    parquet.write_table(pyarrow.table({f"a{i}": [1.0] for i in range(20_000)}), path)


def _endless_query(path: Path) -> None:
    _bag(path, StoragePlugin.SQLITE3)
    with contextlib.closing(sqlite3.connect(path)) as base:
        base.executescript(
            "ALTER TABLE messages RENAME TO kept; CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 "
            "UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, "
            "(SELECT data FROM kept LIMIT 1) AS data FROM n;"
        )


def _large_chunk(path: Path) -> None:
    """A chunk of an MCAP file that announces 8 GB."""
    magic = b"\x89MCAP0\r\n"
    header = struct.pack("<BQI4sI", 1, 12, 4, b"ros2", 0)
    packed = bytes(64)
    chunk = (
        struct.pack("<QQQI", 0, 1, 8 << 30, 0)
        + struct.pack("<I3s", 3, b"lz4")
        + struct.pack("<Q", 64)
        + packed
    )
    path.write_bytes(magic + header + struct.pack("<BQ", 6, len(chunk)) + chunk + magic)


def _text(content: str | bytes) -> Make:
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content)


LAUGHS = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(12))
XML = {
    "laughs": _text(f'<!DOCTYPE robot [<!ENTITY a0 "ha">{LAUGHS}]><robot name="&a12;"/>'),
    "deep": _text("<robot>" * 200_000),
    "entity": _text('<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///dev/zero">]><robot>&a;</robot>'),
    "utf-16": _text('<robot name="a"/>'.encode("utf-16")),
    "attribute": _text(f'<robot name="{"a" * 4_000_000}"/>'),
}
TOML = {
    "dotted": _text(".".join("a" * 30_000) + " = 1"),
    "deep": _text("a = " + "[" * 30_000 + "]" * 30_000),
    "integer": _text("a = " + "9" * 60_000),
    "utf-16": _text("a = 1".encode("utf-16")),
    "latin-1": _text("# größe\na = 1".encode("latin-1")),
}


def _packed(path: Path, plugin: StoragePlugin | None) -> None:
    """A message of 160 MB of zeros, in some kB."""
    store = get_typestore(Stores.LATEST if plugin else Stores.ROS1_NOETIC)
    message = store.types[_ARRAY](store.types["std_msgs/msg/MultiArrayLayout"]([], 0), np.zeros(20_000_000))
    if plugin is None:
        writer: Any = Writer1(path)
        writer.set_compression(Writer1.CompressionFormat.BZ2)
    else:
        writer = Writer(path.parent / "bag", version=9, storage_plugin=plugin)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        pack = store.serialize_cdr if plugin else store.serialize_ros1
        writer.write(writer.add_connection("/u", _ARRAY, typestore=store), 1, pack(message, _ARRAY))
    if plugin is not None:
        (found,) = (path.parent / "bag").glob(f"*{path.suffix}")
        found.rename(path)


YAML = {
    "laughs": _text("a0: &a0 [1]\n" + "".join(f"a{k + 1}: &a{k + 1} [{f'*a{k},' * 9}]\n" for k in range(12))),
    "deep": _text("[" * 100_000),
    "long": _text("a: " + "b" * 10_000_000),
}
CSV = {
    "a long field": _text(f"a,b,y\n1,2,{'9' * 60_000_000}\n"),
    "an open quote": _text('a,b,y\n1,2,"' + "3\n" * 30_000_000),
    "wide": _text(",".join(f"a{i}" for i in range(100_000)) + "\n" + "1," * 99_999 + "1\n"),
    "commas": _text("," * 60_000_000),
    "lines": _text("\n" * 60_000_000),
    "quotes": _text('"' * 60_000_000),
    "fields": _text("a,b,y\n" + '"1\n",' * 10_000_000),
    "zeros": _text(bytes(60_000_000)),
    "utf-16": _text("a,b,y\n1,2,3\n".encode("utf-16")),
    "digits": _text("a,b,y\n" + f"1,2,{'7' * 100_000}\n" * 200),
}
LEARNER = {
    "capacity": _announcing,
    "capacity, 1e9": lambda path: _announcing(path, 10**9),
    "array": lambda path: _announcing(path, shape=(1 << 36,)),
    "deep": _deep,
    "deflated": _deflated,
    "overlapping": _overlapping,
}
TRIAL = {
    "unwritten": _trial(lambda file: file.create_dataset("q", (1 << 29,), dtype="f8", chunks=(1 << 16,))),
    "zeros": _trial(
        lambda file: file.create_dataset("q", data=np.zeros(1 << 25), compression="gzip", chunks=True)
    ),
    "texts": _trial(_same_text),
    "elsewhere": _trial(
        lambda file: file.create_dataset("q", (1 << 20,), dtype="f8", external=[("/dev/zero", 0, 1 << 23)])
    ),
    "a circle": _trial(lambda file: file.__setitem__("q", h5py.SoftLink("/q"))),
    "nothing": _trial(lambda file: file.create_dataset("q", data=h5py.Empty("f8"))),
    "no table": _trial(lambda file: file.attrs.__setitem__("about", "[" * 100_000)),
}

KINDS = {
    "learner": Kind("learner.ekm", _learner, load, LEARNER),
    "knowledge": Kind("hand.ekm", _knowledge, HandKnowledge.load, LEARNER),
    "trial": Kind("trial.h5", lambda path: _trajectory().save(path), Trajectory.load, TRIAL),
    "log": Kind("trial_000000.h5", _log, lambda path: verify_log(path.parent), TRIAL),
    "csv": Kind("table.csv", _csv, load_table, CSV),
    "parquet": Kind("table.parquet", _parquet, load_table, {"constant": _constant_rows, "wide": _wide}),
    "parquet with checksums": Kind("table.parquet", partial(_parquet, write_page_checksum=True), load_table),
    "mcap": Kind(
        "a.mcap", partial(_bag, plugin=StoragePlugin.MCAP), _read_bag,
        {"a chunk of 8 GB": _large_chunk, "packed": partial(_packed, plugin=StoragePlugin.MCAP)},
    ),
    "db3": Kind("a.db3", partial(_bag, plugin=StoragePlugin.SQLITE3), _read_bag, {"endless": _endless_query}),
    "bag": Kind("a.bag", _bag_of_ros_1, _read_bag, {"packed": partial(_packed, plugin=None)}),
    "rosbag2": Kind("bag/metadata.yaml", _folder, lambda path: _read_bag(path.parent), YAML),
    "urdf": Kind("hand.urdf", _hand, load_hand, XML),
    "transmission": Kind(
        "hand.transmission.toml", _hand, lambda path: load_hand(path.with_name("hand.urdf")), TOML
    ),
    "object": Kind(
        "thing.object.toml", _object, lambda path: load_object(path.with_name("thing.urdf")), TOML
    ),
    "mjcf": Kind("hand.xml", _mjcf, load_hand, XML),
    "wiring": Kind("hand.toml", _wiring, _read_wiring, TOML),
}  # fmt: skip


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(8 << 30)


PLACES: dict[str, Make] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": lambda path: path.mkdir(),
    "nowhere": lambda path: path.symlink_to(path.with_name("nothing")),
    "itself": lambda path: path.symlink_to(path),
    "empty": lambda path: path.touch(),
    "sparse": _sparse,
}


# -- changed files ----------------------------------------------------------------------------


def changed(content: bytes, draw: random.Random) -> bytes:
    """With bytes that were changed, cut out, doubled or swapped."""
    data = bytearray(content)
    at, n = draw.randrange(len(data)), draw.choice((1, 4, 8, 64, 512))
    how = draw.choice(("bits", "bytes", "ends", "cut", "out", "twice", "zeros", "large", "swap"))
    if how == "bits":
        for _ in range(n):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == "bytes":
        data[at : at + n] = draw.randbytes(n)
    elif how == "ends":  # where headers and lists of contents are
        at = draw.randrange(min(len(data), 400))
        data[-at - 1 if draw.random() < 0.7 else at] = draw.randrange(256)
    elif how == "cut":
        del data[at:]
    elif how == "out":
        del data[at : at + n]
    elif how == "twice":
        data[at:at] = data[at : at + n]
    elif how == "zeros":
        data[at : at + n] = bytes(n)
    elif how == "large":
        data[at : at + 8] = draw.choice(
            (b"\xff" * 8, b"\x7f" + b"\xff" * 7, b"\xff" * 7 + b"\x7f", b"\0" * 4 + b"\x40" * 4)
        )
    else:
        other = draw.randrange(len(data))
        data[at : at + n], data[other : other + n] = data[other : other + n], data[at : at + n]
    return bytes(data)


def hostile(folder: Path, number: int, seed: int) -> Iterator[tuple[str, str, Path]]:
    """Kind, what is wrong, and path of ``number`` files: those made by hand first."""
    by_hand = [(kind, what) for kind, one in KINDS.items() for what in (*PLACES, *one.made)]
    draw, kinds = random.Random(seed), list(KINDS)
    draw.shuffle(by_hand)
    for k in range(number):
        made = k < min(len(by_hand), number // 3)
        kind, what = by_hand[k] if made else (kinds[k % len(kinds)], "changed")
        here = folder / f"{k}"
        path = here / KINDS[kind].name
        path.parent.mkdir(parents=True)
        make = {**PLACES, **KINDS[kind].made}.get(what)
        if make is None or what in PLACES or what in XML or what in TOML or kind in ("log", "rosbag2"):
            KINDS[kind].write(path)  # with what belongs to it
        if make is not None:
            path.unlink(missing_ok=True)
            make(path)
        else:
            content = changed(path.read_bytes(), draw)
            signs = kind in ("trial", "log") and draw.random() < 0.7
            path.write_bytes(signed(content) if signs else content)
        yield kind, what, path
        shutil.rmtree(here)


# -- reading ----------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came of a file."""

    what: str
    """"read", "refused", or an error that is none of torch_ekm's."""
    seconds: float
    memory: int
    """How much more of it the process took at most than before [bytes]."""


def read_one(kind: str, path: Path) -> Outcome:
    """Read a file in this process."""
    with contextlib.suppress(OSError):  # where the system can: the peak begins here
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before, began = _peak(), time.perf_counter()
    try:
        KINDS[kind].read(path)
        what = "read"
    except EKMError:
        what = "refused"
    except BaseException as error:
        what = f"{type(error).__name__}: {error}"[:200]
    return Outcome(what, time.perf_counter() - began, _peak() - before)


def _peak() -> int:
    with contextlib.suppress(OSError, ValueError):
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024 * int(status.partition("VmHWM:")[2].split()[0])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _work(pipe: Connection) -> None:
    for kind, one in KINDS.items():  # libraries are there before anything is measured
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / one.name
            path.parent.mkdir(exist_ok=True)
            one.write(path)
            read_one(kind, path)
    pipe.send(None)
    while True:
        pipe.send(read_one(*pipe.recv()))


class Reader:
    """A process that reads, and another one where it ends or hangs."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()
        self._pipe.recv()

    def __call__(self, kind: str, path: Path) -> Outcome:
        self._pipe.send((kind, path))
        try:
            if self._pipe.poll(2 * SLOWEST):
                return self._pipe.recv()
            outcome = Outcome("read", 2 * SLOWEST, 0)
        except EOFError:
            outcome = Outcome("the process ended", 0.0, 0)
        self.close()
        self._start()
        return outcome

    def close(self) -> None:
        self._process.kill()
        self._process.join()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", type=int, default=600)
    options = parser.parse_args()
    reader, counts, worst = Reader(), Counter(), Counter()
    with tempfile.TemporaryDirectory() as folder:
        for kind, what, path in hostile(Path(folder), options.files, seed=1000):
            found = reader(kind, path)
            name = found.what if found.what in ("read", "refused") else "untyped"
            slow, large = found.seconds > SLOWEST, found.memory > LARGEST
            counts.update({name: 1, "slow": slow, "large": large})
            worst["seconds"] = max(worst["seconds"], found.seconds)
            worst["memory"] = max(worst["memory"], found.memory)
            if name == "untyped" or slow or large:
                print(
                    f"{kind}, {what}: {found.what}, {found.seconds:.1f} s, {found.memory >> 20} MB",
                    flush=True,
                )
    reader.close()
    print(f"slowest {worst['seconds']:.1f} s, most memory {worst['memory'] >> 20} MB")
    said = f"files {options.files}, read {counts['read']}, refused {counts['refused']}"
    said += f", untyped {counts['untyped']}, slower than {SLOWEST:g} s {counts['slow']}"
    print(f"{said}, above 1 GB {counts['large']}")


if __name__ == "__main__":
    main()
