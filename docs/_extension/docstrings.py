"""Docstrings as they are written here: equations are plain text, so they are shown in fixed width.

```` ``` ```` opens and closes a block of equations, as in Markdown; reStructuredText wants ``::``.
"""

from __future__ import annotations

from typing import Any

from .packages import places


def setup(app: Any) -> None:
    """Connect."""
    app.connect("autodoc-process-docstring", _fences, priority=100)  # before napoleon
    app.connect("autodoc-skip-member", _skip)
    app.connect("autodoc-process-bases", _public_bases)


def _fences(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Fenced blocks as literal blocks."""
    result, inside = [], False
    for line in lines:
        if line.strip().startswith("```"):
            inside = not inside
            result += ["", line.replace(line.strip(), ".. code-block:: text"), ""] if inside else [""]
        else:
            result.append(f"   {line}" if inside else line)
    lines[:] = result


def _skip(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Fields of named tuples that only say their number."""
    return True if (getattr(obj, "__doc__", None) or "").startswith("Alias for field number") else None


def _public_bases(app: Any, name: str, obj: Any, options: Any, bases: list[Any]) -> None:
    """Bases that are public or another package's; the rest is how it is built."""
    public = places()
    bases[:] = [
        base
        for base in obj.__mro__[1:]
        if id(base) in public or (base in obj.__bases__ and not base.__module__.startswith("torch_ekm"))
    ][:1]
