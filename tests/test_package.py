"""The package as a whole: light imports, no ghost names, errors that name what is missing."""

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

# Run where every installed package is missing but torch, numpy, ALSO, and what these themselves ask for.
_LIGHT = """
ALSO = ()
import importlib.machinery, importlib.metadata, re, sys

def plain(name):
    return re.match(r"[\\w.-]+", name)[0].lower().replace("-", "_")

def needed(name, found):
    if name not in found:
        found.add(name)
        try:
            lines = importlib.metadata.requires(name) or ()
        except importlib.metadata.PackageNotFoundError:  # of another platform
            return found
        for line in lines:
            if "extra ==" not in line:
                needed(plain(line), found)
    return found

allowed = {"torch_ekm"}
for name in ("torch", "numpy", *ALSO):
    needed(name, allowed)
owners = importlib.metadata.packages_distributions()
found = {name for name, who in owners.items() if allowed & {plain(one) for one in who}}

class Light(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        spec = super().find_spec(name, path, target)
        places = [str(spec.origin), *(spec.submodule_search_locations or ())] if spec else []
        outside = any("-packages" in place for place in places)
        return None if outside and name.split(".")[0] not in found else spec

sys.meta_path = [Light if one is importlib.machinery.PathFinder else one for one in sys.meta_path]
for package in ("scipy", "sapien", "cv2", "qpsolvers", "pytorch_kinematics", "yourdfpy", "jaxtyping", "coal"):
    try:
        __import__(package)
    except ModuleNotFoundError:
        continue
    raise AssertionError(f"{package} can be imported")
"""
_FRONT_DOOR = """
import torch, torch_ekm
from torch_ekm import EnhancedModel, LearnHyperparameters, SparseOnlineGP, Standardize

for name in torch_ekm.__all__:
    getattr(torch_ekm, name)
state, action = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
for learner in (
    SparseOnlineGP(in_features=4, out_features=2, parts=[Standardize(), LearnHyperparameters()]),
    torch_ekm.RecursiveLeastSquares(4, 2),
    torch_ekm.MixtureResidual(torch_ekm.residual.RandomFeatureRLS(4, 2)),
    torch_ekm.DeepKernelSOGP(4, 2),
    torch_ekm.residual.ReplayMLP(4, 2),
):
    ekm = EnhancedModel(lambda s, a: s + a, learner)
    for _ in range(40):
        assert ekm.update(state, action, state + 2.0 * action).accepted
    value, jacobian = ekm.linearize(state, action)
    assert float((value - 2.0).abs().max()) < 0.5, (learner, value)
    assert jacobian.shape == (2, 2)
"""


_ROOMS = """
import importlib
from torch_ekm.exceptions import MissingExtraError

for room in ("plant", "sensing", "simulation", "rendering", "interop", "experiments"):
    importlib.import_module(f"torch_ekm.{room}")
from torch_ekm import interop

for use, extra in (
    (lambda: interop.RiverResidual(3, 2), "peers"),
    (lambda: interop.as_river, "interop"),
    (lambda: interop.to_casadi, "interop"),
):
    try:
        use()
    except MissingExtraError as error:
        assert error.extra == extra
    else:
        raise AssertionError(extra)
"""


def test_front_door_and_rooms_need_torch_and_numpy_only() -> None:
    """The rooms and their adapters ask for their extras when they need them."""
    done = subprocess.run(
        [sys.executable, "-c", _LIGHT + _FRONT_DOOR + _ROOMS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


_PLOTS = ("matplotlib", "scipy", "jinja2", "typer", "rich")
_HEAVY = {"sapien", "vtk", "pyvista", "h5py", "qpsolvers", "trimesh", "cv2"}
_COMMANDS = f"""
import sys
from torch_ekm.cli import main

def run(*arguments):
    print("$", *arguments, flush=True)
    sys.argv = ["torch-ekm", *arguments]
    try:
        main()
    except SystemExit as end:
        return end.code or 0
    return 0

learners = ("--learners", "linear RLS,model alone", "--limit", "45", "--out", "out")
assert run("compare", "--data", "one.csv", "--data", "two.csv", *learners) == 0
assert run("notebooks", "--copy", "copies") == 0
assert run("--version") == 0
assert run("demo") == 1
assert not {_HEAVY} & {{name.partition('.')[0] for name in sys.modules}}
"""


def test_the_command_line_compares_and_copies_with_the_extra_plots_alone(tmp_path: Path) -> None:
    """A CSV needs no simulator; a command that needs more names the extra that brings all of it."""
    rows = ["a,b,y", *(f"{k % 7},{k % 11},{k % 7 + k % 11}" for k in range(50))]
    for name in ("one", "two"):
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
    light = _LIGHT.replace('("scipy", ', "(")  # which this extra brings
    code = light.replace("ALSO = ()", f"ALSO = {_PLOTS}") + _COMMANDS
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    compared, copied_and_told = done.stdout.split("$ notebooks")
    assert "On the first 45 of 50 rows" in " ".join(compared.split())
    assert (tmp_path / "out" / "index.html").is_file()
    assert len(list((tmp_path / "copies").glob("*.ipynb"))) >= 6
    assert "torch-ekm" in copied_and_told.split("$ --version")[1]
    assert "pip install 'torch_ekm[robot]'; all commands run with extra 'experiments'" in done.stderr


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
    extras = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    packages = {
        "cv2": "opencv-python",
        "IPython": "ipykernel",
        "rclpy": "ros-rclpy",
        **{f"{name}_msgs": f"ros-{name}-msgs" for name in ("sensor", "trajectory", "geometry", "std")},
    }
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


def test_a_message_does_not_print_whole_matrices() -> None:
    error = exceptions.ParameterError("A", [[1.0] * 100] * 100, "a number")
    assert len(str(error)) < 400
    assert str(error).endswith("... is not valid; it must be a number")
    assert len(error.value) == 100


def test_every_exported_name_exists() -> None:
    for info in pkgutil.walk_packages(torch_ekm.__path__, "torch_ekm."):
        module = importlib.import_module(info.name)
        for name in getattr(module, "__all__", ()):
            assert hasattr(module, name), f"{info.name} exports {name}, which does not exist"


ROOT = Path(__file__).parents[1]


def test_actions_stand_by_their_hashes() -> None:
    used = [
        (path.name, line)
        for path in sorted((ROOT / ".github" / "workflows").glob("*.yml"))
        for line in re.findall(r"- uses: (.*)", path.read_text(encoding="utf-8"))
    ]
    assert len(used) > 10
    assert [one for one in used if not re.fullmatch(r"[\w/-]+@[0-9a-f]{40}  # v[\d.]+", one[1])] == []


def test_hashes_are_those_of_what_is_pinned() -> None:
    def pinned(name: str) -> dict[str, str]:
        text = (ROOT / name).read_text(encoding="utf-8")
        found = re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE)
        return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}

    constraints = pinned("constraints.txt")
    assert constraints.pop("torch")  # a machine chooses its build
    assert pinned("constraints.lock") == constraints
    blocks = re.split(r"\n(?=\w)", (ROOT / "constraints.lock").read_text(encoding="utf-8"))[1:]
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", block) for block in blocks)


def test_licences_of_what_extras_bring_are_named() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    ours = ["test", "docs", "dev", "notebooks"]  # of those who work on it
    named = [
        *project["dependencies"],
        *(one for extra in extras if extra not in ours for one in extras[extra]),
    ]
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    packages = {re.match(r"[\w-]+", one)[0] for one in named} - {"torch_ekm"}  # pyright: ignore
    assert [one for one in sorted(packages) if not re.search(rf"(?<![\w-]){one}(?![\w-])", notice)] == []
