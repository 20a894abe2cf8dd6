"""What an object was made with, as plain values: to compare it with a state, and to make it anew."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from .exceptions import ParameterError, StateMismatchError

#: options that decide nothing of what a state means
_FREE = ("device", "on_invalid", "backend")


class Recorded:
    """Remembers the arguments of its constructor, so that a subclass has nothing to do for it."""

    starts: ClassVar[tuple[str, ...]] = ()
    """Arguments that only start values which are part of the state."""

    def __new__(cls, *args: Any, **options: Any):
        made = super().__new__(cls)
        try:
            bound = inspect.signature(cls.__init__).bind(made, *args, **options)
        except TypeError:  # copies get their attributes afterwards; a wrong call fails in the constructor
            return made
        bound.apply_defaults()
        given = list(bound.arguments.items())[1:]
        kinds = inspect.signature(cls.__init__).parameters
        arguments: dict[str, Any] = {}
        for name, value in given:
            if kinds[name].kind is inspect.Parameter.VAR_POSITIONAL and not value:
                continue  # of a constructor that is nn.Module's own
            if kinds[name].kind is inspect.Parameter.VAR_KEYWORD:
                arguments |= {key: plain(one) for key, one in value.items()}
            else:
                arguments[name] = plain(value)
        object.__setattr__(made, "_arguments", arguments)
        return made


def describe(thing: Recorded) -> dict[str, Any]:
    """``{"class": name, "arguments": {name: value}}``, of what it holds now where it holds an argument."""
    arguments = dict(vars(thing).get("_arguments", {}))
    for name in arguments:
        held = getattr(thing, name, None)
        if isinstance(held, Recorded):
            arguments[name] = describe(held)
        elif isinstance(held, nn.ModuleList):
            arguments[name] = [plain(one) for one in held]
    for name in ("dtype", "batch_shape"):  # .to() changes one of them
        if hasattr(thing, name):
            arguments[name] = plain(getattr(thing, name))
    return {"class": type(thing).__name__, "arguments": arguments}


def plain(value: Any) -> Any:
    """The value in terms of JSON; what has no such terms is ``{"opaque": its type}``."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Recorded):
        return describe(value)
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, torch.Tensor | np.ndarray):
        return {"tensor": value.tolist(), "dtype": str(value.dtype).removeprefix("torch.")}
    if isinstance(value, torch.dtype):
        return {"dtype": str(value).removeprefix("torch.")}
    if isinstance(value, torch.device):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {one.name: plain(getattr(value, one.name)) for one in dataclasses.fields(value)}
        return {"class": type(value).__name__, "arguments": fields}
    if isinstance(value, type) or inspect.isfunction(value):
        ours = str(value.__module__).startswith("torch_ekm.")
        return {"named": value.__qualname__} if ours else {"opaque": value.__qualname__}
    return {"opaque": type(value).__name__}


def make(described: Any, known: Mapping[str, Any]) -> Any:
    """What :func:`describe` told of, made anew of the classes ``known`` by their names.

    Raises:
        ParameterError: a name is not known, or something had no plain terms.
    """
    if isinstance(described, list):
        return [make(one, known) for one in described]
    if not isinstance(described, dict):
        return described
    if "opaque" in described:
        raise ParameterError("file", described["opaque"], "of learners whose arguments are plain values")
    if "tensor" in described or "dtype" in described:
        dtype = getattr(torch, str(described["dtype"]), None)
        if not isinstance(dtype, torch.dtype):
            raise ParameterError("dtype", described["dtype"], "the name of one of torch's")
        return torch.tensor(described["tensor"], dtype=dtype) if "tensor" in described else dtype
    name = str(described.get("class", described.get("named")))
    if name not in known:
        raise ParameterError("class", name, f"one of {', '.join(sorted(known))}; pass others as `classes`")
    if "named" in described:
        return known[name]
    return known[name](**{key: make(value, known) for key, value in described["arguments"].items()})


def opaque_arguments(described: Any, place: str = "") -> list[str]:
    """Names of the arguments that have no plain terms."""
    if isinstance(described, list):
        return [name for one in described for name in opaque_arguments(one, place)]
    if not isinstance(described, dict):
        return []
    if "opaque" in described:
        return [f"{place} ({described['opaque']})"]
    inside = described.get("arguments", {})
    return [found for name, one in inside.items() for found in opaque_arguments(one, name)]


def differences(theirs: Any, ours: Any, known: Mapping[str, tuple[str, ...]], place: str = "") -> list[str]:
    """``"capacity: 12 in the state, 8 here"`` for each option that decides what a state means."""
    if isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        pairs = enumerate(zip(theirs, ours, strict=True))
        return [text for i, (a, b) in pairs for text in differences(a, b, known, f"{place}[{i}]")]
    if isinstance(theirs, dict) and isinstance(ours, dict) and "class" in theirs and "class" in ours:
        if theirs["class"] != ours["class"]:
            return [f"{place or 'class'}: {theirs['class']} in the state, {ours['class']} here"]
        a, b = theirs["arguments"], ours["arguments"]
        free = {*_FREE, *known.get(ours["class"], ())}
        names = [name for name in b if name in a and name not in free]
        lead = f"{place}." if place else ""
        return [text for name in names for text in differences(a[name], b[name], known, lead + name)]
    return [] if theirs == ours else [f"{place}: {_short(theirs)} in the state, {_short(ours)} here"]


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_short, value)) + "]"
    if isinstance(value, dict):
        return str(value.get("class", value.get("dtype", value.get("opaque", value))))
    return repr(value)


def check_state(module: nn.Module, state: Mapping[str, Any]) -> None:
    """That a state dict is one of this module, before anything of it is written.

    Raises:
        StateMismatchError: entries are missing or too many, of other shapes or dtypes, not numbers (NaN), or
            of a learner that was made otherwise.
    """
    own = module.state_dict()
    wrong: list[str] = []
    starts = {type(one).__name__: one.starts for one in module.modules() if isinstance(one, Recorded)}
    for name, ours in own.items():
        theirs = state.get(name)
        if isinstance(ours, dict) and isinstance(theirs, dict) and "made_with" in ours:
            made = theirs.get("made_with")
            if made is not None:
                wrong += differences(made, ours["made_with"], starts, name.removesuffix("_extra_state")[:-1])
    if wrong:
        raise StateMismatchError(wrong)
    wrong += [f"{name} is missing" for name in own if name not in state]
    wrong += [f"{name} does not belong here" for name in state if name not in own]
    parameters = dict(module.named_parameters())
    for name, ours in own.items():
        theirs = state.get(name)
        if theirs is None or not isinstance(ours, torch.Tensor):
            continue
        if not isinstance(theirs, torch.Tensor):
            wrong.append(f"{name} is no tensor")
        elif theirs.shape != ours.shape or theirs.dtype != ours.dtype:
            here = f"{tuple(ours.shape)} of {ours.dtype} here"
            wrong.append(f"{name}: {tuple(theirs.shape)} of {theirs.dtype} in the state, {here}")
        elif bool(theirs.isnan().any()) or (name in parameters and not bool(theirs.isfinite().all())):
            wrong.append(f"{name} holds something that is not a number")
    if wrong:
        raise StateMismatchError(wrong)
