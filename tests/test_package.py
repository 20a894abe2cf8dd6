"""The package as a whole: light imports, no ghost names, errors that name what is missing."""

from __future__ import annotations

import importlib
import pickle
import pkgutil
import subprocess
import sys

import pytest

import torch_ekm
from torch_ekm import exceptions
from torch_ekm._extras import require
from torch_ekm.exceptions import EKMError, MissingExtraError

_HEAVY = (
    "scipy",
    "coal",
    "sapien",
    "cv2",
    "qpsolvers",
    "pytorch_kinematics",
    "matplotlib",
    "typer",
    "gymnasium",
)


_LIGHT = ("", ".residual", ".enhanced.enhanced_model", ".plant", ".sensing", ".simulation", ".rendering")


@pytest.mark.parametrize("module", [f"torch_ekm{name}" for name in _LIGHT])
def test_import_needs_only_torch_and_numpy(module: str) -> None:
    blocked = ", ".join(repr(name) for name in _HEAVY)
    code = f"""
import sys
for name in ({blocked}):
    sys.modules[name] = None  # importing it now raises ModuleNotFoundError
import {module}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_missing_extra_is_named() -> None:
    with pytest.raises(MissingExtraError, match=r"torch_ekm\[all\]|torch_ekm\[") as info:
        require("surely_not_installed")
    assert isinstance(info.value, EKMError)
    assert isinstance(info.value, ImportError)
    assert info.value.module == "surely_not_installed"


def test_errors_cross_process_boundaries_whole() -> None:
    errors = [
        exceptions.UnknownNameError("hand", "foo", ["icub_right"]),
        exceptions.JointMismatchError("file.toml", ["a"], ["b"], ["a", "c"]),
        exceptions.ShapeError("q", "(20,)", (3,)),
        exceptions.UnstableGraspError("buckles", -0.1, [1.0]),
        exceptions.SolverError("piqp", "failed", "a hint"),
        MissingExtraError("coal", "robot"),
    ]
    for error in errors:
        copy = pickle.loads(pickle.dumps(error))
        assert type(copy) is type(error)
        assert str(copy) == str(error)
        assert vars(copy) == vars(error)


def test_every_exported_name_exists() -> None:
    for info in pkgutil.walk_packages(torch_ekm.__path__, "torch_ekm."):
        module = importlib.import_module(info.name)
        for name in getattr(module, "__all__", ()):
            assert hasattr(module, name), f"{info.name} exports {name}, which does not exist"
