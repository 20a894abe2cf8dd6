"""Every block of Python in the documentation runs as printed: page by page, in order, in one namespace."""

import ast
import doctest
import importlib.util
import re
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from dynamixel_bus import DynamixelBus
from motors import Motors

PORT = "/dev/ttyUSB0"
DOCS = Path(__file__).parents[2] / "docs"
_BLOCK = re.compile(r"^( *)```python\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[str]:
    """Each preceded by as many empty lines as stand above it, so that errors name the line of the page."""
    text = page.read_text(encoding="utf-8")
    return [
        "\n" * text[: one.start(2)].count("\n") + textwrap.dedent(one[2]) for one in _BLOCK.finditer(text)
    ]


def sources() -> list[Path]:
    written = {"_build", "generated", "notebooks"}
    return [page for page in sorted(DOCS.rglob("*.md")) if not written & {*page.relative_to(DOCS).parts}]


def name_of(page: Path) -> str:
    return str(page.relative_to(DOCS))


def skip_without_its_packages(code: list[str]) -> None:
    for block in code:
        for node in ast.walk(ast.parse(block)):
            named = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in named:
                if importlib.util.find_spec(name.partition(".")[0]) is None:
                    pytest.skip(f"{name} is not installed")


@pytest.fixture
def serial_port() -> Iterator[str]:
    """What a page calls its serial port: two emulated servos answer there."""
    with DynamixelBus([1, 2], Motors([1600.0, 1600.0], 4000.0)) as bus:
        yield bus.port


@pytest.mark.parametrize("page", [one for one in sources() if blocks(one)], ids=name_of)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch, request):
    code = blocks(page)
    skip_without_its_packages(code)
    if any(PORT in block for block in code):
        code = [block.replace(PORT, request.getfixturevalue("serial_port")) for block in code]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    module = types.ModuleType("documentation_page")  # classes of a page can be pickled
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with torch.random.fork_rng(devices=[]):
        for block in code:
            exec(compile(block, str(page), "exec"), vars(module))


@pytest.mark.parametrize("page", [one for one in sources() if ">>> " in one.read_text("utf-8")], ids=name_of)
def test_the_sessions_of_a_page_give_what_is_printed(page: Path) -> None:
    failed, run = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert run
    assert failed == 0
