"""Which packages are public, and on which one's page each name is documented."""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass, field
from typing import Any

# in the order in which data flows
PACKAGES = [
    "torch_ekm",
    "torch_ekm.description",
    "torch_ekm.kinematics",
    "torch_ekm.contact",
    "torch_ekm.model",
    "torch_ekm.model.calibration",
    "torch_ekm.residual",
    "torch_ekm.enhanced",
    "torch_ekm.object_memory",
    "torch_ekm.plant",
    "torch_ekm.control",
    "torch_ekm.control.guards",
    "torch_ekm.foresight",
    "torch_ekm.sensing",
    "torch_ekm.simulation",
    "torch_ekm.rendering",
    "torch_ekm.interop",
    "torch_ekm.experiments",
    "torch_ekm.testing",
    "torch_ekm.exceptions",
    "torch_ekm.typing",
]
# their names are listed where they come from, not where they are offered again
_LAST = ["torch_ekm.control.guards", "torch_ekm"]


@dataclass
class Page:
    """What a package's page shows: its own names, and links to those that it takes from another package."""

    own: list[tuple[str, str]] = field(default_factory=list)
    """(directive, name)"""
    elsewhere: list[tuple[str, str]] = field(default_factory=list)
    """(name, package that documents it)"""


def pages() -> dict[str, Page]:
    """A page for each public package; each name has one place."""
    found = {package: Page() for package in PACKAGES}
    place: dict[int, str] = {}
    for package in sorted(PACKAGES, key=lambda one: _LAST.index(one) + 1 if one in _LAST else 0):
        module = importlib.import_module(package)
        for name in sorted(module.__all__, key=str.lower):
            value = getattr(module, name)
            if inspect.ismodule(value):
                found[package].elsewhere.append((name, value.__name__))
            elif id(value) in place:
                found[package].elsewhere.append((name, place[id(value)]))
            else:
                place[id(value)] = package
                found[package].own.append((_directive(value), name))
    return found


def _directive(value: Any) -> str:
    if getattr(value, "__module__", "torch_ekm").partition(".")[0] != "torch_ekm":
        return "py:data"  # of another package, which documents it
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    return "autofunction" if inspect.isroutine(value) else "autodata"


def places() -> dict[int, str]:
    """id of each public object -> its full name, where it is documented."""
    return {
        id(getattr(importlib.import_module(package), name)): f"{package}.{name}"
        for package, page in pages().items()
        for _, name in page.own
    }
