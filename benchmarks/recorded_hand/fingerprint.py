"""What decides a job's result, as a digest: values, and the code of functions and classes."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, ModuleType
from typing import Any

import torch

_PLAIN = (bool, int, float, complex, str, bytes, type(None), torch.dtype, torch.device)
_BY_NAME = {
    *sys.stdlib_module_names,
    "torch",
    "numpy",
    "scipy",
    "jaxtyping",
    "beartype",
}  # packages whose code does not count


def fingerprint(*values: Any) -> str:
    """Hexadecimal digest of values and of all that they hold, the same in every process.

    Tensors and arrays count with their contents, objects with their class and their state. Classes and
    functions count with their bytecode, and with that of the functions, classes and plain constants that it
    names in its module; those of Python, torch, numpy, scipy and of checkers of annotations count with their
    names.
    """
    known: dict[int, tuple[Any, str]] = {}  # holds the value too: its id must not come again

    def digest(value: Any) -> str:
        if isinstance(value, _PLAIN):
            return f"{type(value).__name__} {value!r}"
        if id(value) not in known:
            known[id(value)] = value, "itself"  # what a circle ends at
            parts = [digest(part) for part in _parts(value)]
            parts = sorted(parts) if isinstance(value, set | frozenset) else parts
            text = repr([type(value).__name__, *parts])
            known[id(value)] = value, hashlib.sha1(text.encode()).hexdigest()
        return known[id(value)][1]

    return digest(values)


def _parts(value: Any) -> Iterable[Any]:
    match value:
        case torch.Tensor():
            return [value.detach().cpu().numpy()]
        case dict():
            return (part for item in value.items() for part in item)
        case list() | tuple() | set() | frozenset():
            return value
        case CodeType():
            return [value.co_code, value.co_names, *value.co_consts]
        case ModuleType() | BuiltinFunctionType():
            return [value.__name__]
        case CellType():
            return [value.cell_contents] if value != CellType() else []
        case FunctionType():
            return _function(value)
        case type():
            return _class(value)
    return _object(value)


def _function(function: FunctionType) -> Iterator[Any]:
    yield from (function.__module__, function.__qualname__, function.__defaults__, function.__kwdefaults__)
    yield function.__closure__  # a decorator of torch's holds what it decorates
    if _counts(function):
        yield function.__code__
        for name in _names(function.__code__):
            named = function.__globals__.get(name)
            if isinstance(named, (*_PLAIN, FunctionType, type)):
                yield named


def _class(cls: type) -> Iterator[Any]:
    yield from (cls.__module__, cls.__qualname__)
    if _counts(cls):
        yield cls.__bases__
        for name, member in sorted(vars(cls).items()):
            member = getattr(member, "__func__", getattr(member, "fget", member))
            if isinstance(member, FunctionType) or not name.startswith("_"):
                yield from (name, member)


def _object(value: Any) -> Iterator[Any]:
    try:
        made_of = value.__reduce_ex__(2)
    except TypeError:  # what cannot be copied: a lock, an open file
        made_of = type(value), getattr(value, "__dict__", None)
    for part in (made_of,) if isinstance(made_of, str) else made_of:
        yield list(part) if isinstance(part, Iterator) else part


def _names(code: CodeType) -> list[str]:
    inner = [name for const in code.co_consts if isinstance(const, CodeType) for name in _names(const)]
    return [*code.co_names, *inner]


def _counts(value: FunctionType | type) -> bool:
    return (value.__module__ or "builtins").partition(".")[0] not in _BY_NAME
