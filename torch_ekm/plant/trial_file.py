"""A trial's file: HDF5 behind a first line with a digest of every byte of it."""

from __future__ import annotations

import hashlib
import io
import json
import re
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from .._files import write_whole
from ..exceptions import DescriptionError

FORMAT = "torch_ekm trial 2"
_LARGEST = 4 << 30  # bytes of all arrays of a trial: a small file can claim any size
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
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DescriptionError(path, "no recording: it is no file but a folder, a pipe or a device")
        if status.st_size > _LARGEST:
            raise DescriptionError(path, f"more than {_LARGEST} bytes")
        content = bytearray(path.read_bytes())
    except FileNotFoundError:
        raise DescriptionError(path, "no such recording") from None
    except OSError as error:
        raise DescriptionError(path, f"cannot be read: {error.strerror}") from None
    head = _LINE.match(content)
    if head is None:
        first = f"a recording starts with a line '{FORMAT}', which this file does not"
        raise DescriptionError(path, f"damaged, or not a recording of this version of torch_ekm: {first}")
    written_digest = head[1].decode()
    whole = content[:_HEAD] == _head(written_digest)
    content[:_HEAD] = _head("0" * 64)
    if not whole or hashlib.sha256(content).hexdigest() != written_digest:
        raise DescriptionError(path, "damaged: its bytes are not those that were written (SHA-256)")
    h5py = require("h5py")
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            arrays: dict[str, np.ndarray] = {}

            def take(place: str, item: Any) -> None:
                if not isinstance(item, h5py.Dataset) or not wanted(place):
                    return
                if item.external or item.is_virtual:
                    raise DescriptionError(path, f"'{place}' lies in another file")
                if sum(array.nbytes for array in arrays.values()) + item.nbytes > _LARGEST:
                    raise DescriptionError(path, f"more than {_LARGEST} bytes of arrays")
                arrays[place] = item[()]

            file.visititems(take)
            return int(file.attrs["seed"]), json.loads(file.attrs["about"]), arrays
    except DescriptionError:
        raise
    except Exception as error:  # a file that was made to look right fails in any way HDF5 can think of
        raise DescriptionError(path, f"damaged recording: {type(error).__name__}: {error}") from None


def _head(digest: str) -> bytes:
    return f"{FORMAT}\nsha256 {digest}\n".encode().ljust(_HEAD, b"\0")
