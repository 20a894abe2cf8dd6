"""What an object was made with, as plain values: to compare it with a state, and to make it again."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from .exceptions import ParameterError, StateError, StateMismatchError

#: options that decide nothing of what a state means
_FREE = ("device", "on_invalid")


class Recorded:
    """Remembers the arguments of its constructor, so that a subclass has nothing to do for it."""

    starts: ClassVar[tuple[str, ...]] = ()
    """Arguments that only start values which are part of the state."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        of_method = inspect.signature(cls.__init__)  # what help() shows; else it would be that of __new__
        cls.__signature__ = of_method.replace(parameters=list(of_method.parameters.values())[1:])

    def __new__(cls, *args: Any, **options: Any):
        made = super().__new__(cls)
        signature = inspect.signature(cls.__init__)
        try:
            bound = signature.bind(made, *args, **options)
        except TypeError:  # copies get their attributes afterwards; a wrong call fails in the constructor
            return made
        bound.apply_defaults()
        arguments: dict[str, Any] = {}
        for name, value in list(bound.arguments.items())[1:]:
            kind = signature.parameters[name].kind
            if kind is inspect.Parameter.VAR_POSITIONAL and not value:
                continue  # of a constructor that is nn.Module's own
            if kind is inspect.Parameter.VAR_KEYWORD:
                arguments |= {key: plain(one) for key, one in value.items()}
            else:
                arguments[name] = plain(value)
        object.__setattr__(made, "_arguments", arguments)
        return made


def describe(thing: Recorded) -> dict[str, Any]:
    """``{"class": name, "arguments": {name: value}}``, of what it holds now where it holds an argument."""
    arguments = dict(getattr(thing, "_arguments", {}))
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
    if isinstance(value, np.generic):
        return plain(value.item())
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
    """What :func:`describe` wrote down, made again of the classes ``known`` by their names.

    Raises:
        ParameterError: a name is not known.
        StateError: something had no plain terms.
    """
    if isinstance(described, list):
        return [make(one, known) for one in described]
    if not isinstance(described, dict):
        return described
    if "opaque" in described:
        raise StateError(f"a {described['opaque']} stands where learners of files have plain values")
    if "tensor" in described or "dtype" in described:
        dtype = getattr(torch, str(described["dtype"]), None)
        if not isinstance(dtype, torch.dtype):
            raise ParameterError("dtype", described["dtype"], "the name of one of torch's")
        return torch.tensor(described["tensor"], dtype=dtype) if "tensor" in described else dtype
    name = str(described.get("class", described.get("named")))
    if name not in known:
        valid = f"one of {', '.join(sorted(known))}"
        raise ParameterError("class", name, f"passed as classes=[{name}] if it is your own, else {valid}")
    if "named" in described:
        return known[name]
    arguments = {key: make(value, known) for key, value in described["arguments"].items()}
    if isinstance(arguments.get("batch_shape"), list):
        arguments["batch_shape"] = tuple(arguments["batch_shape"])  # JSON has no tuples
    return known[name](**arguments)


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

    A module in it with a method ``state_problems(state) -> list of texts`` is asked for what is wrong with
    its own entries, once their shapes are right: counts and places that lie outside of its memory, say.

    Raises:
        StateMismatchError: entries are missing or too many, of other shapes or dtypes, NaN or infinite,
            counts below 0, or of a learner that was made otherwise.
    """
    own = module.state_dict()
    wrong = _made_otherwise(module, own, state) or ill_formed(own, state) or _impossible(module, state)
    if wrong:
        raise StateMismatchError(wrong)


def _made_otherwise(module: nn.Module, own: Mapping[str, Any], state: Mapping[str, Any]) -> list[str]:
    wrong: list[str] = []
    starts = {type(one).__name__: one.starts for one in module.modules() if isinstance(one, Recorded)}
    for name, ours in own.items():
        theirs = state.get(name)
        if isinstance(ours, dict) and isinstance(theirs, dict) and "made_with" in ours:
            place = name.removesuffix("_extra_state")[:-1]
            try:
                wrong += differences(theirs["made_with"], ours["made_with"], starts, place)
            except Exception as error:  # whatever a strange description makes of it
                wrong.append(f"{name}: what it was made with cannot be read ({type(error).__name__})")
    return wrong


def ill_formed(own: Mapping[str, Any], state: Mapping[str, Any], place: str = "") -> list[str]:
    """What is wrong with the entries of ``state``, against a state dict of the same module."""
    wrong = [f"{place}{name} is missing" for name in own if name not in state]
    wrong += [f"{place}{name} does not belong here" for name in state if name not in own]
    for name, ours in own.items():
        if name in state and name != "made_with":
            wrong += _ill_formed(place + name, ours, state[name], inside=bool(place))
    return wrong


def _ill_formed(name: str, ours: Any, theirs: Any, inside: bool) -> list[str]:
    """Of one entry: a tensor, a count, a mark, or a mapping of those."""
    if isinstance(ours, torch.Tensor) and not inside:
        if not isinstance(theirs, torch.Tensor):
            return [f"{name} is no tensor"]
        if theirs.shape != ours.shape or theirs.dtype != ours.dtype:
            here = f"{tuple(ours.shape)} of {ours.dtype} here"
            return [f"{name}: {tuple(theirs.shape)} of {theirs.dtype} in the state, {here}"]
        return [f"{name} holds something that is not a number"] if bool(theirs.isnan().any()) else []
    if isinstance(ours, dict) and isinstance(theirs, dict):
        # another library's own mappings are looked at by the module that holds them
        return [] if inside else ill_formed(ours, theirs, f"{name}.")
    if type(ours) is not type(theirs):
        return [f"{name}: {type(theirs).__name__} in the state, {type(ours).__name__} here"]
    if isinstance(ours, int) and not 0 <= theirs < 2**53:
        return [f"{name} counts, and is below 0 or beyond 2^53"]
    return []


def _impossible(module: nn.Module, state: Mapping[str, Any]) -> list[str]:
    """Entries of the right form, with values that no module of this package comes to."""
    wrong: list[str] = []
    for prefix, one in module.named_modules():
        lead = f"{prefix}." if prefix else ""
        inner = {name[len(lead) :]: value for name, value in state.items() if name.startswith(lead)}
        if type(one).__module__.startswith(("torch_ekm.", "torch.nn.")):
            kept = (*one.named_parameters(recurse=False), *one.named_buffers(recurse=False))
            for name, ours in kept:
                if name in inner and not _in_bounds(inner[name], ours):
                    wrong.append(f"{lead}{name} is infinite, or counts and is below 0")
        ask = getattr(one, "state_problems", None)
        if ask is not None and not wrong:  # it may count on what was looked at here
            wrong += [f"{lead}{text}" for text in ask(inner)]
    return wrong


def _in_bounds(theirs: torch.Tensor, ours: torch.Tensor) -> bool:
    """Finite where ours is, and no count below 0."""
    if theirs.is_floating_point():  # a limit may be infinite
        return not bool((theirs.isinf() & ours.isfinite()).any())
    return theirs.dtype == torch.bool or not bool(((theirs < 0) & (ours >= 0)).any())


def covariance_problems(name: str, P: torch.Tensor, largest: torch.Tensor | None = None) -> list[str]:
    """What is wrong with covariances ``(*batch, n, n)`` of a state.

    Args:
        largest: variances that nothing exceeds ``(n,)``; None: any.
    """
    size, variance = P.abs().amax(), P.diagonal(dim1=-2, dim2=-1)
    symmetric = bool(((P - P.mT).abs() <= 1e-9 * size).all())
    if not symmetric or not bool((torch.linalg.eigvalsh(P)[..., 0] > 0).all()):
        return [f"{name} is no covariance"]
    if largest is not None and bool((variance > (1 + 1e-6) * largest).any()):
        return [f"{name}: less is known than at the start"]
    return []


def precision_problems(name: str, A: torch.Tensor) -> list[str]:
    """The same of matrices of information ``(*batch, n, n)``, which may be singular, to rounding."""
    rounding = math.sqrt(torch.finfo(A.dtype).eps) * float(A.abs().amax())
    symmetric = bool(((A - A.mT).abs() <= rounding).all())
    known = symmetric and bool((torch.linalg.eigvalsh(A.double())[..., 0] >= -rounding).all())
    return [] if known else [f"{name} is negative in some direction, or not symmetric"]


def bound_problems(state: Mapping[str, Any], **bounds: tuple[float, float]) -> list[str]:
    """Entries of a state that leave the range which their estimator keeps to: ``name=(least, largest)``."""
    found = []
    for name, (least, largest) in bounds.items():
        value, lower, upper = state[name], least - 1e-9 * abs(least), largest + 1e-9 * abs(largest)
        if not bool(((value >= lower) & (value <= upper)).all()):
            found.append(f"{name} is not within {least:.6g} and {largest:.6g}")
    return found
