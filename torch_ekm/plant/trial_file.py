"""A trial's file: HDF5 behind a first line with a digest of every byte of it."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import check_announced, opened, told_as_damage, write_whole
from ..exceptions import DescriptionError

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
