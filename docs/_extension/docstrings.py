"""Docstrings as they are written here: equations are plain text, so they are shown in fixed width.

```` ``` ```` opens and closes a block of equations, as in Markdown; reStructuredText has a directive for it.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import textwrap
from typing import Any

from sphinx import addnodes
from sphinx.util.inspect import TypeAliasForwardRef, signature, stringify_signature

from .packages import data_comment, public_bases


def setup(app: Any) -> None:
    """Connect."""
    app.connect("autodoc-process-docstring", _prepare, priority=100)  # napoleon has 500
    app.connect("autodoc-process-docstring", _restore, priority=900)
    app.connect("object-description-transform", _without_value)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-bases", _bases)
    app.connect("autodoc-skip-member", _skip)
    TypeAliasForwardRef.__repr__ = lambda self: self.name  # in unions it would show its own kind


_prepared: dict[tuple[str, str], list[str]] = {}


def _prepare(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Fenced blocks become literal blocks; comments become the text of constants."""
    if what == "data":
        lines[:] = data_comment(name.rpartition(".")[2], obj)
    result, inside = [], False
    for line in lines:
        if line.strip().startswith("```"):
            inside = not inside
            result += ["", line.replace(line.strip(), ".. code-block:: text"), ""] if inside else [""]
        else:
            result.append(f"   {line.replace('``', '')}" if inside else line)
    lines[:] = result
    _prepared[what, name] = result


def _restore(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Napoleon takes what stands before a colon in a field's first line for its type."""
    before = _prepared.pop((what, name))
    if what in ("attribute", "data", "property") and "Raises:" not in before:
        lines[:] = before


def _without_value(app: Any, domain: str, kind: str, content: addnodes.desc_content) -> None:
    """Fields show their type; their default stands in the signature, as written."""
    if kind != "attribute" or content.parent is None:
        return
    for line in content.parent.findall(addnodes.desc_signature):
        notes = [node for node in line if isinstance(node, addnodes.desc_annotation)]
        if len(notes) > 1 and notes[-1].astext().startswith(" = "):
            line.remove(notes[-1])


class _Source:
    """A default as it stands in the source, ``16 * DEGREE`` rather than 0.27925."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _signature(
    app: Any, what: str, name: str, obj: Any, options: Any, text: str | None, returns: str | None
) -> tuple[str, None] | None:
    """Of dataclasses with defaults as written; none where a class is not made by calling it."""
    if not inspect.isclass(obj):
        return None
    if issubclass(obj, enum.Enum) or getattr(obj, "_is_protocol", False):
        return "", None
    written: dict[str, str] = {}
    if dataclasses.is_dataclass(obj) and "__init__" not in _own(obj):
        for one in reversed(obj.__mro__):
            if dataclasses.is_dataclass(one):
                written |= _defaults(one)
    elif hasattr(obj, "__signature__"):
        written = _defaults_of_method(obj.__init__)
    else:
        return None
    found = signature(obj, type_aliases=app.config.autodoc_type_aliases)
    parameters = [
        one.replace(default=_Source(written[one.name]))
        if one.default is not one.empty and one.name in written
        else one
        for one in found.parameters.values()
    ]
    shown = found.replace(parameters=parameters, return_annotation=found.empty)
    return stringify_signature(shown, unqualified_typehints=True), None


def _own(kind: type) -> list[str]:
    body = _body(kind)
    return [node.name for node in body if isinstance(node, ast.FunctionDef)]


def _defaults(kind: type) -> dict[str, str]:
    """Field -> the default's source."""
    found: dict[str, str] = {}
    for node in _body(kind):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            found[node.target.id] = _value(node.value)
    return found


def _defaults_of_method(method: Any) -> dict[str, str]:
    """Argument -> the default's source."""
    if not inspect.isfunction(method):
        return {}
    (parsed,) = ast.parse(textwrap.dedent(inspect.getsource(method))).body
    assert isinstance(parsed, ast.FunctionDef)
    given = parsed.args
    plain = zip(given.args[len(given.args) - len(given.defaults) :], given.defaults, strict=True)
    named = ((one, value) for one, value in zip(given.kwonlyargs, given.kw_defaults, strict=True) if value)
    return {one.arg: ast.unparse(value) for one, value in (*plain, *named)}


def _value(node: ast.expr) -> str:
    """``field(default_factory=Kind)`` as ``Kind()``."""
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("field"):
        given = {one.arg: one.value for one in node.keywords}
        if "default" in given:
            return ast.unparse(given["default"])
        if "default_factory" in given:
            made = given["default_factory"]
            return ast.unparse(made.body) if isinstance(made, ast.Lambda) else f"{ast.unparse(made)}()"
    return ast.unparse(node)


def _body(kind: type) -> list[ast.stmt]:
    (parsed,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(parsed, ast.ClassDef)
    return parsed.body


def _bases(app: Any, name: str, obj: Any, options: Any, bases: list[Any]) -> None:
    bases[:] = public_bases(obj)


def _skip(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Fields of named tuples that only say their number, and what learners' constructors note."""
    numbered = (getattr(obj, "__doc__", None) or "").startswith("Alias for field number")
    return True if numbered or name in ("starts", "stands_last") else None
