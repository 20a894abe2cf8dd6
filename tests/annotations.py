"""Shape annotations are checked in the first hundred calls of each test.

:mod:`jaxtyping` binds the sizes of a call to each other; :mod:`beartype` checks types. ``int`` is taken where
``float`` is annotated, as type checkers do (PEP 484).
"""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

#: Checks of one test; the rest of its calls, most of them in long streams, repeat the same shapes.
BUDGET = 100
#: Packages whose annotations are checked.
CHECKED: tuple[str, ...] = ("kinematics", "contact", "model", "residual", "enhanced", "control")


_count = [0]


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The type checker of the import hook, which also counts.

    A function within another is made, and would be compiled anew, in each call of it: it stays unchecked.
    """
    if "<locals>" in function.__qualname__:
        return function
    checked = beartype(function, conf=BeartypeConf(is_pep484_tower=True))
    if isinstance(checked, type):
        return checked

    @functools.wraps(checked)
    def counted(*args: Any, **options: Any) -> Any:
        _count[0] += 1
        if _count[0] == BUDGET:
            jaxtyping.config.update("jaxtyping_disable", True)
        return checked(*args, **options)

    return counted


def begin_test() -> None:
    """The next test has checks of its own."""
    _count[0] = 0
    jaxtyping.config.update("jaxtyping_disable", False)


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
