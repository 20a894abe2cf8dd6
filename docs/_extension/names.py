"""References to names of the package, whatever path they are written with, lead to the one place."""

from __future__ import annotations

import importlib
from typing import Any

from docutils import nodes

from .packages import places


def setup(app: Any) -> None:
    """Connect."""
    app.connect("missing-reference", _resolve)


def _resolve(app: Any, env: Any, node: Any, contnode: nodes.Node) -> nodes.Node | None:
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    full = _full_name(target)
    domain = env.get_domain("py")
    if full is not None:
        node["py:module"] = node["py:class"] = None
        return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", full, node, contnode)
    if "refexplicit" not in node or not target.startswith("torch_ekm"):
        return contnode  # a type in a signature that is private here, or another package's: no link
    return None


def _full_name(target: str) -> str | None:
    """Where a dotted name is documented: ``torch_ekm.residual.base.ResidualLearner.update`` ->
    ``torch_ekm.residual.ResidualLearner.update``."""
    known = places()
    if "." not in target:  # of an annotation that is not evaluated
        named = [full for full in known.values() if full.rpartition(".")[2] == target]
        return named[0] if len(named) == 1 else None
    parts = target.split(".")
    for cut in range(len(parts) - 1, 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        for done, part in enumerate(parts[cut:], cut + 1):
            value = getattr(value, part, None)
            if id(value) in known:
                return ".".join([known[id(value)], *parts[done:]])
        return None
    return None
