"""Shape annotations are checked in every call that the tests make.

:mod:`jaxtyping` binds the sizes of a call to each other; :mod:`beartype` checks types. ``int`` is taken where
``float`` is annotated, as type checkers do (PEP 484).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

#: Packages whose annotations are checked.
CHECKED: tuple[str, ...] = ("kinematics", "contact", "model", "residual", "enhanced", "control")


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The type checker of the import hook."""
    return beartype(function, conf=BeartypeConf(is_pep484_tower=True))


def install() -> None:
    """Check what is imported from here on; the environment's ``CHECK_SHAPES`` names other packages."""
    named = os.environ.get("CHECK_SHAPES")
    packages = CHECKED if named is None else tuple(filter(None, named.split(",")))
    if packages:
        modules = [module for name in packages for module in _modules(name)]
        jaxtyping.install_import_hook(modules, "annotations.check")


def _modules(package: str) -> list[str]:
    """Names of a package's files, but for those of compiled loops: numba takes no wrapped functions."""
    root = Path(__file__).parents[1]
    files = sorted((root / "torch_ekm" / package).rglob("*.py"))
    return [".".join(f.relative_to(root).with_suffix("").parts) for f in files if "numba_" not in f.name]
