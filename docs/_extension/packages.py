"""Which packages are public, and on which one's page each name is documented."""

from __future__ import annotations

import builtins
import enum
import functools
import importlib
import inspect
import pkgutil
import re
import sys
from dataclasses import dataclass, field
from typing import Any

import torch_ekm

_ALSO = [
    "torch_ekm.testing",
    "torch_ekm.notebook",
    "torch_ekm.exceptions",
    "torch_ekm.typing",
]  # public modules that are no packages
# its names are listed where they come from, not where they are offered again
_LAST = "torch_ekm"


@dataclass(frozen=True)
class Entry:
    """A name on a page."""

    name: str
    directive: str
    bases: bool
    """Whether it states what it is derived from."""
    choices: bool
    """Whether it is an enumeration, which shows all members."""
    summary: str


@dataclass
class Page:
    """What a package's page shows: its own names, and links to those that it takes from another package."""

    own: list[Entry] = field(default_factory=list)
    elsewhere: list[tuple[str, str, str]] = field(default_factory=list)
    """(name, where it is documented, summary)"""


@functools.cache
def packages() -> list[str]:
    """All packages whose ``__all__`` has a name, and the public modules."""
    found = ["torch_ekm"]
    for info in pkgutil.walk_packages(torch_ekm.__path__, "torch_ekm."):
        if info.name.startswith("torch_ekm.cli"):
            continue  # its reference is that of the commands
        if info.ispkg and getattr(importlib.import_module(info.name), "__all__", ()):
            found.append(info.name)
    return found + _ALSO


def pages() -> dict[str, Page]:
    """A page for each public package; each name has one place."""
    found = {package: Page() for package in packages()}
    places = _places()
    for package, page in found.items():
        module = importlib.import_module(package)
        for name in sorted(module.__all__, key=str.lower):
            value = getattr(module, name)
            if inspect.ismodule(value):
                page.elsewhere.append((name, value.__name__, _summary(value, name)))
            elif places[id(value)] == f"{package}.{name}":
                shown = any(base is not object for base in public_bases(value))
                page.own.append(Entry(name, _directive(value), shown, _is_enum(value), _summary(value, name)))
            else:
                page.elsewhere.append((name, places[id(value)], _summary(value, name)))
    return found


@functools.cache
def places() -> dict[int, str]:
    """id of each public object -> its full name, where it is documented."""
    return {key: name for key, name in _places().items() if name.partition(".")[0] == "torch_ekm"}


@functools.cache
def _places() -> dict[int, str]:
    found: dict[int, str] = {}
    for package in sorted(packages(), key=lambda one: one == _LAST):
        module = importlib.import_module(package)
        for name in module.__all__:
            found.setdefault(id(getattr(module, name)), f"{package}.{name}")
    return found


def public_bases(value: Any) -> list[type]:
    """The first base that is public or another package's; private ones are how it is built."""
    if not inspect.isclass(value):
        return []
    public = _places()
    for base in value.__mro__[1:]:
        ours = base.__module__.partition(".")[0] == "torch_ekm"
        if id(base) in public or not (
            ours or hasattr(builtins, base.__name__) or base.__module__ == "typing"
        ):
            return [base]
    return [object]


def data_comment(name: str, value: Any) -> list[str]:
    """The ``#:`` comment of a constant, wherever in the package it is assigned."""
    from sphinx.pycode import ModuleAnalyzer

    for module in list(sys.modules):
        if module.partition(".")[0] == "torch_ekm" and getattr(sys.modules[module], name, None) is value:
            found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
            if found:
                return found
    return []


def _is_enum(value: Any) -> bool:
    return inspect.isclass(value) and issubclass(value, enum.Enum)


def _directive(value: Any) -> str:
    if getattr(value, "__module__", "torch_ekm").partition(".")[0] not in ("torch_ekm", "types"):
        return "py:data"  # of another package, which documents it
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    return "autofunction" if inspect.isroutine(value) else "autodata"


def _summary(value: Any, name: str) -> str:
    """The first sentence of a docstring, equations left whole."""
    if _directive(value) == "py:data":
        return f"``{value.__module__}.{getattr(value, '__name__', name)}``."
    text = (
        (value.__doc__ or "")
        if callable(value) or inspect.ismodule(value)
        else "\n".join(data_comment(name, value))
    )
    paragraph = " ".join(text.strip().split("\n\n")[0].split())
    parts = re.split(r"(``.*?``)", paragraph)  # a full stop within an equation ends no sentence
    for k in range(0, len(parts), 2):
        end = re.search(
            r"(?<!eq)(?<!e\.g)(?<!i\.e)\. (?=[A-Z:`])", parts[k] + (" A" if k == len(parts) - 1 else "")
        )
        if end:
            return "".join(parts[:k]) + parts[k][: end.start()] + "."
    return paragraph.removesuffix("::") + ("" if paragraph.endswith((".", "::")) else ".")
