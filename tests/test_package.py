"""The package as a whole: light imports, no ghost names, errors that name what is missing."""

from __future__ import annotations

import ast
import importlib
import pickle
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import torch_ekm
from torch_ekm import exceptions
from torch_ekm._extras import _EXTRA_OF, require
from torch_ekm.exceptions import EKMError, MissingExtraError

_HEAVY = (
    "scipy",
    "coal",
    "sapien",
    "cv2",
    "qpsolvers",
    "pytorch_kinematics",
    "yourdfpy",
    "trimesh",
    "matplotlib",
    "typer",
    "gymnasium",
)


@pytest.mark.parametrize("module", ["torch_ekm", "torch_ekm.residual", "torch_ekm.enhanced.enhanced_model"])
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


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coal", None)  # importing it raises ModuleNotFoundError
    with pytest.raises(MissingExtraError, match=r"pip install 'torch_ekm\[robot\]'") as info:
        require("coal")
    assert isinstance(info.value, EKMError)
    assert isinstance(info.value, ImportError)
    assert info.value.module == "coal"
    with pytest.raises(KeyError):  # no extra is made up for a module that the table does not have
        require("surely_not_installed")


def imported_roots() -> set[str]:
    """First parts of the names of all modules that the package imports or requires."""
    names: set[str] = set()
    for file in Path(torch_ekm.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(str(node.module))
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "require":
                assert isinstance(node.args[0], ast.Constant), f"{file}: the name must be written out"
                names.add(node.args[0].value)
    core = {"torch", "numpy", "torch_ekm", "jaxtyping"}  # jaxtyping: of the tests, see typing.py
    return {name.split(".")[0] for name in names} - sys.stdlib_module_names - core


def test_every_optional_module_has_an_extra_that_brings_it() -> None:
    """The table holds each module that is asked for and no other; each extra exists and lists its package."""
    assert imported_roots() == set(_EXTRA_OF)
    project = Path(torch_ekm.__file__).parents[1] / "pyproject.toml"
    if not project.is_file():
        pytest.skip("pyproject.toml is not part of this installation")
    extras = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    packages = {"cv2": "opencv-python", "mpl_toolkits": "matplotlib", "IPython": "ipykernel"}
    for root, extra in _EXTRA_OF.items():
        listed = {re.split(r"[\[>=]", line)[0] for line in extras[extra]}
        assert packages.get(root, root.replace("_", "-")) in listed, f"{root}: not in the extra '{extra}'"


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
