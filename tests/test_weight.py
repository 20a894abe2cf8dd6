"""The ratchet: what the project weighs, held at the ceilings of weight.toml.

``python tests/test_weight.py`` prints what is weighed, as that file has it.
"""

import ast
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torch_ekm"
CEILINGS = tomllib.loads(Path(__file__).with_name("weight.toml").read_text(encoding="utf-8"))
BRANCHES = 10
_TUNED = ("estimation", "control")


def lines(folder: Path) -> int:
    """Of all modules in a folder."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def complex_functions() -> list[str]:
    """Functions of the package above :data:`BRANCHES` branches, as ruff counts them (McCabe)."""
    words = ["check", "--isolated", "--exit-zero", "--select", "C901", "--output-format", "json"]
    words += ["--config", f"lint.mccabe.max-complexity = {BRANCHES}", str(PACKAGE)]
    done = subprocess.run([sys.executable, "-m", "ruff", *words], capture_output=True, text=True, check=True)
    return [f"{Path(one['filename']).name}: {one['message']}" for one in json.loads(done.stdout)]


def tuned(source: str) -> Iterator[str]:
    """Names of numeric constants of a module, and of numeric defaults of the fields of its classes."""
    module = ast.parse(source)
    for body in (module.body, *(node.body for node in ast.walk(module) if isinstance(node, ast.ClassDef))):
        for node in body:
            if (
                isinstance(node, ast.Assign | ast.AnnAssign)
                and node.value is not None
                and _number(node.value)
            ):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                yield from (name.id for name in targets if isinstance(name, ast.Name))


def _number(value: ast.expr) -> bool:
    """A number, arithmetic with one, or numbers in a tuple."""
    match value:
        case ast.Constant():
            return isinstance(value.value, int | float) and not isinstance(value.value, bool)
        case ast.UnaryOp():
            return _number(value.operand)
        case ast.BinOp():
            return _number(value.left) or _number(value.right)
        case ast.Tuple():
            return bool(value.elts) and all(map(_number, value.elts))
    return False


def exported() -> int:
    """Names in ``__all__`` of the package and its public packages."""
    count = 0
    for path in PACKAGE.rglob("__init__.py"):
        if any(part.startswith("_") for part in path.relative_to(PACKAGE).parts[:-1]):
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [name for name in getattr(node, "targets", ()) if isinstance(name, ast.Name)]
            if any(name.id == "__all__" for name in names):
                count += len(ast.literal_eval(node.value))  # pyright: ignore[reportAttributeAccessIssue]
    return count


def weights() -> dict[str, dict[str, int]]:
    """What there is now, as weight.toml has it."""
    folders = sorted(path for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py")))
    numbers = {
        name: sum(len(list(tuned(path.read_text("utf-8")))) for path in (PACKAGE / name).rglob("*.py"))
        for name in _TUNED
    }
    return {
        "lines": {
            "package": lines(PACKAGE),
            **{folder.name: lines(folder) for folder in folders},
            "benchmarks": lines(ROOT / "benchmarks"),
            "tests": lines(ROOT / "tests"),
        },
        "numbers": {
            **numbers,
            "functions_above_ten_branches": len(complex_functions()),
            "exported": exported(),
        },
    }


def test_nothing_weighs_more_than_its_ceiling() -> None:
    found = weights()
    assert {group: set(names) for group, names in found.items()} == {
        group: set(names) for group, names in CEILINGS.items()
    }
    above = [
        f"{group}.{name}: {now}, ceiling {CEILINGS[group][name]}"
        for group, names in found.items()
        for name, now in names.items()
        if now > CEILINGS[group][name]
    ]
    assert not above, f"lower another one and say which, in weight.toml: {'; '.join(above)}"


def test_numbers_are_counted_wherever_they_are_tuned() -> None:
    source = "A = 3\n_B = 0.3 * DEG\nC: float = -1.0\nD = (1, 2.0)\nE = 'x'\nF = True\nG = call(3)\n"
    source += "class H:\n    near: float = 0.5\n    name: str = ''\n    other: int\n"
    assert list(tuned(source)) == ["A", "_B", "C", "D", "near"]


if __name__ == "__main__":
    for group, names in weights().items():
        print(f"[{group}]", *(f"{name} = {now}" for name, now in names.items()), "", sep="\n")
