"""docs/interop.md: every example runs as printed."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "interop.md"
BLOCKS = (
    re.findall(r"^## (.*?)\n.*?```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    if PAGE.is_file()
    else []
)


@pytest.mark.parametrize(("title", "block"), BLOCKS, ids=[title for title, _ in BLOCKS])
def test_the_example_runs(title: str, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = [node for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {
        name
        for node in nodes
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names])
    }
    if title.startswith("ONNX"):
        names |= {"onnx", "onnxscript"}
    for name in names:
        if importlib.util.find_spec(str(name).split(".")[0]) is None:
            pytest.skip(f"{name} is not installed")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, PAGE.name, "exec"), {})


def test_every_section_has_an_example() -> None:
    if not PAGE.is_file():
        pytest.skip("the documentation is not part of this installation")
    sections = re.findall(r"^## (.*)$", PAGE.read_text("utf-8"), re.MULTILINE)
    assert [title for title, _ in BLOCKS] == sections
