"""Shape annotations are checked in the first fifty calls of each test.

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
BUDGET = 50
#: Packages whose annotations are checked.
CHECKED: tuple[str, ...] = ("kinematics", "contact", "model", "residual", "enhanced", "control")


__name__ = "jaxtyping.lazily"  # warnings name the line that led to what is checked
_count = [0]
_checked = functools.partial(
    jaxtyping.jaxtyped, typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True))
)


def lazily(*, typechecker: None) -> Callable[..., Any]:
    """In place of :func:`jaxtyping.jaxtyped`, which the import hook calls by this name: a function's checks
    are made when it is first called, and past the budget calls go straight to it.

    A function within another is made, and would be compiled anew, in each call of it: it stays unchecked.
    """

    def decorated(function: Callable[..., Any]) -> Callable[..., Any]:
        if isinstance(function, type):
            return _checked(function)
        checked = functools.cache(lambda: _checked(function))

        @functools.wraps(function)
        def counted(*args: Any, **options: Any) -> Any:
            if _count[0] >= BUDGET:
                return function(*args, **options)
            _count[0] += 1
            if _count[0] == BUDGET:
                jaxtyping.config.update("jaxtyping_disable", True)  # for dataclasses, too
            return checked()(*args, **options)

        return function if "<locals>" in function.__qualname__ else counted

    return decorated


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
        jaxtyping.jaxtyped = lazily
        jaxtyping.install_import_hook(modules, None)


def _modules(package: str) -> list[str]:
    """Names of a package's files, but for those of compiled loops: numba takes no wrapped functions."""
    root = Path(__file__).parents[1]
    files = sorted((root / "torch_ekm" / package).rglob("*.py"))
    return [".".join(f.relative_to(root).with_suffix("").parts) for f in files if "numba_" not in f.name]
