"""The compiled loops: loaded from numba's cache, or compiled by another process while torch does the work."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from ...._warnings import warn
from ....exceptions import SpeedWarning

_LAST = "torch_ekm.residual.numba_mixture"  #: of the modules of loops, which imports the others
_LAST_LOOP = "mix_fleet"  #: of that module: what is compiled last
_OFF = (
    "compiled loops are off, so learners take longer: {}; if numba cannot write its cache, set "
    "NUMBA_CACHE_DIR to a folder that can be written"
)
_FIRST_TIME = (
    "a process in the background compiles loops, once and for about a minute; until then torch does the "
    "work, and results may differ by rounding. torch_ekm.warm_up() waits for them"
)


class Loader:
    """Finds the loops once in a process."""

    def __init__(self) -> None:
        self._loops: ModuleType | None = None
        self._is_done = False
        self._compiler: subprocess.Popen | None = None

    def load(self, *, wait: bool = False) -> ModuleType | None:
        """The loops; None where numba is missing, does not fit numpy, or cannot write its cache, and as long
        as another process compiles them."""
        if not self._is_done and (wait or not self._is_compiled_elsewhere()):
            if self._compiler is not None:
                self._compiler.wait()
            self._loops, self._is_done = _imported(), True
        return self._loops

    def _is_compiled_elsewhere(self) -> bool:
        if self._compiler is None:
            if not sys.executable or importlib.util.find_spec("numba") is None or _is_cached():
                return False
            code = "import torch_ekm; torch_ekm.warm_up()"
            path, silent = os.pathsep.join(filter(None, sys.path)), subprocess.DEVNULL
            try:
                self._compiler = subprocess.Popen(
                    [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path},
                    stdin=silent, stdout=silent, stderr=silent,
                )  # fmt: skip
            except OSError:
                return False
            warn(_FIRST_TIME, SpeedWarning)
        return self._compiler.poll() is None


_loader = Loader()


def load_loops(*, wait: bool = False) -> Any:
    """See :meth:`Loader.load`."""
    return _loader.load(wait=wait)


def _imported() -> ModuleType | None:
    try:
        _is_cached()
        return importlib.import_module(_LAST)
    except ImportError as error:
        if error.name not in ("numba", "llvmlite"):  # it is there, and does not fit
            warn(_OFF.format(error), SpeedWarning)
        return None
    except RuntimeError as error:
        warn(_OFF.format(error), SpeedWarning)
        return None


def _is_cached() -> bool:
    """Whether what numba made of the last of the loops is there, as far as one can see.

    Numba looks at the file of a loop alone: what it made before any file of the learners changed goes, since
    figures of others stand in it.
    """
    from numba.misc.appdirs import user_cache_dir

    given, sources = os.environ.get("NUMBA_CACHE_DIR"), list(Path(__file__).parents[2].rglob("*.py"))
    written = max(file.stat().st_mtime for file in sources)
    names = [f"{file.stem}.*.py{sys.version_info.major}{sys.version_info.minor}.nbi" for file in sources]
    folders = [Path(given)] if given else [Path(user_cache_dir("numba", False)), *{f.parent for f in sources}]
    found = {index for folder in folders for name in names for index in folder.glob(f"*/{name}")}
    kept = []
    for index in found:
        with contextlib.suppress(OSError):  # another process may have taken it away by now
            if index.stat().st_mtime < written:
                index.unlink()
            else:
                kept.append(index)
    return any(f".{_LAST_LOOP}-" in index.name for index in kept)
