"""Learners in files: what they were made with and all figures of their state, and nothing that could run."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from .._files import check_announced, opened, told_as_damage, write_whole
from .._recorded import Recorded, check_state, make, opaque_arguments
from ..exceptions import FileFormatError, NoStateError

_FORMAT = "torch_ekm learner 1"
_HEADER = "header.json"
_LARGEST = 4 << 30  # bytes
_LARGEST_HEADER = 10_000_000
_MOST_OBJECTS = 2000  # that a learner is made of
_MOST_CHOICES = 10_000  # of an object: the product of the lengths of its lists


def write(path: str | os.PathLike, described: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """A zip file of a JSON header and one ``.npy`` for each tensor, in place at once or not at all.

    Args:
        described: what the learner was made with.
        state: a state dict; nested values of it must be plain or tensors.

    Raises:
        NoStateError: an argument or an entry has no plain terms.
        OutputError: the file cannot be written.
    """
    wrong = opaque_arguments(described)
    if wrong:
        raise NoStateError(
            str(described.get("class")),
            f"{', '.join(wrong)}; save the rest, such as ekm.learner, or its state_dict()",
        )
    tensors: dict[str, torch.Tensor] = {}
    packed = {name: _pack(value, tensors, str(described.get("class"))) for name, value in state.items()}
    header = {"format": _FORMAT, "made_with": described, "state": packed}
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(_HEADER, json.dumps(header))
        for name, tensor in tensors.items():
            with archive.open(name, "w", force_zip64=True) as entry:
                array = np.ascontiguousarray(tensor.detach().cpu().numpy()).reshape(tensor.shape)
                np.lib.format.write_array(entry, array, allow_pickle=False)
    write_whole(Path(path), memory.getvalue())


def read(path: str | os.PathLike) -> tuple[dict[str, Any], dict[str, Any]]:
    """What :func:`write` wrote: the description and the state.

    Raises:
        FileFormatError: it is no such file, or damaged.
    """
    with (
        opened(path, "file of a learner", _LARGEST, FileFormatError) as file,
        told_as_damage(path, "file", FileFormatError),
    ):
        try:
            archive = zipfile.ZipFile(file)
        except zipfile.BadZipFile:
            raise FileFormatError(path, "not written by torch_ekm.save, or cut short") from None
        with archive:
            entries = archive.infolist()
            if _HEADER not in archive.namelist():
                raise FileFormatError(path, "not written by torch_ekm.save")
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise FileFormatError(path, "compressed entries, which no learner's file has")
            if sum(entry.file_size for entry in entries) > os.fstat(file.fileno()).st_size:
                raise FileFormatError(path, "entries that are larger than the file")
            if archive.getinfo(_HEADER).file_size > _LARGEST_HEADER:
                raise FileFormatError(path, "a header that is too large")
            header = json.loads(archive.read(_HEADER))
            if not isinstance(header, dict) or header.get("format") != _FORMAT:
                raise FileFormatError(path, f"not a file of format '{_FORMAT}'")
            tensors = {one.filename: _array(archive.read(one)) for one in entries if one.filename != _HEADER}
            return header["made_with"], {name: _unpack(one, tensors) for name, one in header["state"].items()}


def _array(entry: bytes) -> torch.Tensor:
    """Of ``.npy``, whose header cannot announce more than there is."""
    file = io.BytesIO(entry)
    np.lib.format.read_magic(file)
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    figures = np.frombuffer(entry, dtype, offset=file.tell())
    return torch.from_numpy(figures.reshape(shape, order="F" if fortran else "C").copy())


def rebuild(
    path: str | os.PathLike, described: Any, state: Mapping[str, Any], known: Mapping[str, Any]
) -> nn.Module:
    """The object described, made of the classes ``known``, in this state.

    Raises:
        FileFormatError: it cannot be made.
        StateMismatchError: the state is not one of it.
    """
    there = sum(one.nbytes for one in state.values() if isinstance(one, torch.Tensor))
    with told_as_damage(path, "description, or one of another version", FileFormatError), _Sized(path, there):
        if _objects(described) > _MOST_OBJECTS:
            raise FileFormatError(path, f"more than {_MOST_OBJECTS} objects, or choices without number")
        made = make(described, known)
    if not isinstance(made, nn.Module):
        raise FileFormatError(path, "describes no learner")
    check_state(made, state)
    made.load_state_dict(state)
    return made


def _objects(described: Any) -> int:
    """How many a description makes; one with too many choices counts for all."""
    if not isinstance(described, dict | list):
        return 0
    inside = list(described.values()) if isinstance(described, dict) else described
    lengths = (len(one) for one in inside if isinstance(one, list) and one)
    many = isinstance(described, dict) and math.prod(lengths) > _MOST_CHOICES
    own = isinstance(described, dict) and "class" in described
    return own + many * (_MOST_OBJECTS + 1) + sum(map(_objects, inside))


class _Sized(TorchDispatchMode):
    """What is made takes memory that goes with its state: a result's size is known before it is there.

    Raises:
        FileFormatError: it takes more than 64 MiB, and 8 times the state.
    """

    def __init__(self, path: str | os.PathLike, there: int) -> None:
        super().__init__()
        self._path, self._there, self._taken = path, there, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if all(one.alias_info is None for one in func._schema.returns):  # no view, nothing in place
            with contextlib.suppress(RuntimeError):  # of what depends on data, and makes nothing large
                plan_args, plan = tree_map_only(torch.Tensor, lambda x: x.to("meta"), (args, kwargs))
                if "device" in plan:
                    plan["device"] = torch.device("meta")
                made = tree_leaves(func(*plan_args, **plan))
                self._taken += sum(one.nbytes for one in made if isinstance(one, torch.Tensor))
        check_announced(self._path, self._taken, self._there, FileFormatError, times=8)
        return func(*args, **kwargs)


def known_classes(classes: Iterable[type] = ()) -> dict[str, Any]:
    """Classes of this package that record what they were made with, and those given, by name."""
    own = [kind for kind in _subclasses(Recorded) if kind.__module__.startswith("torch_ekm.")]
    return {kind.__name__: kind for kind in (*own, *classes)}


def _subclasses(kind: type) -> Iterator[type]:
    for one in kind.__subclasses__():
        yield one
        yield from _subclasses(one)


def _pack(value: Any, tensors: dict[str, torch.Tensor], learner: str) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return {"value": value}
    if isinstance(value, torch.Tensor):
        if value.dtype == torch.bfloat16:
            raise NoStateError(learner, "numpy has no bfloat16")
        name = f"{len(tensors)}.npy"
        tensors[name] = value
        return {"tensor": name}
    if isinstance(value, list | tuple):
        return {"list": [_pack(one, tensors, learner) for one in value]}
    if isinstance(value, Mapping):
        return {"dict": [[key, _pack(one, tensors, learner)] for key, one in value.items()]}
    raise NoStateError(learner, f"its state holds a {type(value).__name__}")


def _unpack(packed: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    if "tensor" in packed:
        return tensors[packed["tensor"]]
    if "list" in packed:
        return [_unpack(one, tensors) for one in packed["list"]]
    if "dict" in packed:
        return {key: _unpack(one, tensors) for key, one in packed["dict"]}
    return packed["value"]
