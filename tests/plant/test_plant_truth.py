"""The truth of a simulation is for simulated sensors and for reports; nothing else reads it."""

import ast
from pathlib import Path

import torch_ekm

PACKAGE = Path(torch_ekm.__file__).parent
MAY = {
    "plant/plant.py": "defines it",
    "plant/trajectory.py": "stores it",
    "simulation/": "makes it, and draws what simulated sensors see",
    "experiments/": "reports it",
    "inspection/": "shows it",
}


def mentions(source: str) -> list[int]:
    """Lines that read or write an attribute ``truth``, in the open or by its name, or use ``Truth``."""
    found = []
    for node in ast.walk(ast.parse(source)):
        attribute = isinstance(node, ast.Attribute) and node.attr in ("truth", "Truth")
        name = isinstance(node, ast.Name) and node.id == "Truth"
        imported = isinstance(node, ast.ImportFrom) and any(alias.name == "Truth" for alias in node.names)
        text = isinstance(node, ast.Constant) and node.value == "truth"
        keyword = isinstance(node, ast.keyword) and node.arg == "truth"
        if attribute or name or imported or text or keyword:
            found.append(node.lineno)
    return sorted(found)


def test_nothing_that_controls_senses_or_learns_reads_the_truth() -> None:
    files = {path.relative_to(PACKAGE).as_posix(): path for path in PACKAGE.rglob("*.py")}
    assert {name.split("/")[0] for name in files} >= {
        *("control", "enhanced", "sensing", "model", "residual")
    }
    found = {name: mentions(path.read_text(encoding="utf-8")) for name, path in files.items()}
    readers = {name for name, lines in found.items() if lines and not name.startswith(tuple(MAY))}
    assert readers == {"plant/__init__.py"}  # exports the type
    for place in MAY:  # what may read it does: the test finds what it looks for
        assert any(lines for name, lines in found.items() if name.startswith(place)), place
