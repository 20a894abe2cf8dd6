"""Tables of options: each field with its default and what is said of it in the code."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import re
from typing import Any

from sphinx.pycode import ModuleAnalyzer

# title -> (package, classes)
GROUPS = {
    "Kinematic model": ("torch_ekm.model", ["ModelOptions"]),
    "Contact forces": ("torch_ekm.contact", ["ForceOptions"]),
    "Controller: tasks": (
        "torch_ekm.control",
        ["FocusTask", "OffAxisTask", "GripForceTask", "EffortTask"],
    ),
    "Controller: limits": (
        "torch_ekm.control",
        ["ActuatorLimit", "JointLimit", "NormalForceLimit"],
    ),
    "Controller: size of a step": ("torch_ekm.control", ["LimitingFunction"]),
    "Plan": ("torch_ekm.control", ["WholeTurn"]),
    "Closed loop": ("torch_ekm.control", ["StoppingRule", "Guards"]),
    "Simulation": ("torch_ekm.simulation", ["PlantConfig"]),
}


def parameters() -> str:
    """All tables."""
    parts = []
    for title, (package, names) in GROUPS.items():
        parts.append(f"## {title}")
        for name in names:
            kind = getattr(importlib.import_module(package), name)
            rows = [
                f"| `{one.name}` | {shown(default_of(one), text)} | {text} |"
                for one, text in ((one, _text(kind, one.name)) for one in dataclasses.fields(kind))
            ]
            parts.append(f"{{class}}`~{package}.{name}`")
            parts.append("\n".join(["| field | default | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def presets() -> str:
    """What the presets of the simulated hand change."""
    from torch_ekm.simulation import PRESETS, PlantParameters

    names = list(PRESETS)
    rows = []
    for one in dataclasses.fields(PlantParameters):
        text = _text(PlantParameters, one.name)
        values = [shown(getattr(PRESETS[name], one.name), text) for name in names]
        rows.append(f"| `{one.name}` | {' | '.join(values)} | {text} |")
    return "\n".join(
        [f"| field | {' | '.join(names)} | meaning |", "|---|" + "---|" * (len(names) + 1), *rows]
    )


def default_of(one: dataclasses.Field) -> Any:
    """A field's default."""
    if one.default is not dataclasses.MISSING:
        return one.default
    return dataclasses.MISSING if one.default_factory is dataclasses.MISSING else one.default_factory()


def shown(value: Any, text: str) -> str:
    """A default for readers: angles in degrees as well as in radians."""
    if value is dataclasses.MISSING:
        return "required"
    if isinstance(value, tuple) and value:
        return "(" + ", ".join(shown(one, text) for one in value) + ")"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"`{value}`" if not dataclasses.is_dataclass(value) else f"`{type(value).__name__}()`"
    if isinstance(value, float) and "[rad]" in text and value:
        return f"{value:.4g} ({math.degrees(value):.4g} deg)"
    return "infinite" if value == math.inf else f"{value:.4g}" if isinstance(value, float) else str(value)


def _text(kind: type, name: str) -> str:
    for base in kind.__mro__:
        if base.__module__.startswith("torch_ekm"):
            found = ModuleAnalyzer.for_module(base.__module__).find_attr_docs().get((base.__qualname__, name))
            if found:
                return _markdown(" ".join(" ".join(found).split()))
    return _markdown(" ".join((_argument(kind, name) or "").split()))


def _argument(kind: type, name: str) -> str | None:
    """From the class's list of attributes."""
    found = re.search(
        rf"^ +{name}: (.*?)(?=\n +\w+: |\n\n|\Z)", inspect.getdoc(kind) or "", re.DOTALL | re.MULTILINE
    )
    return found[1] if found else None


def _markdown(text: str) -> str:
    """From reStructuredText: references and literals become code."""
    literals: list[str] = []

    def keep(found: re.Match) -> str:
        literals.append(found[1].rpartition(".")[2] if found[0].startswith(":") else found[1])
        return f"\0{len(literals) - 1}\0"

    text = text.replace("**", "")
    text = re.sub(r":\w+:`~?([^`]*)`", keep, text)
    text = re.sub(r"``(.*?)``", keep, text)
    text = re.sub(r"([\[\]<>*_|])", r"\\\1", text)
    return re.sub(r"\0(\d+)\0", lambda found: "`" + literals[int(found[1])].replace("|", r"\|") + "`", text)
