"""What the pages' text must keep: its size, and the keys of the files that it describes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from torch_ekm.description import transmission

DOCS = Path(__file__).parents[2] / "docs"
_BUDGET = 12_000  # words that somebody wrote for users; benchmarks and API are printed by commands
_NOT_FOR_USERS = {"_build", "benchmarks", "generated", "notebooks", "development"}


@pytest.fixture(autouse=True)
def _documentation() -> None:
    if not DOCS.is_dir():
        pytest.skip("the documentation is not part of this installation")


def words(page: Path) -> int:
    """Of text and tables; code is not counted."""
    text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return sum(1 for word in text.split() if re.search(r"\w", word))


def test_the_documentation_stays_short() -> None:
    counted = {
        str(page.relative_to(DOCS)): words(page)
        for page in sorted(DOCS.rglob("*.md"))
        if not _NOT_FOR_USERS & {*page.relative_to(DOCS).parts}
    }
    counted["README.md"] = words(DOCS.parent / "README.md")
    over = sum(counted.values()) - _BUDGET
    assert over <= 0, f"cut {over} words, or more: {counted}"


def test_every_key_of_a_transmission_file_is_documented() -> None:
    page = (DOCS / "reference" / "file_formats.md").read_text(encoding="utf-8")
    keys = {*transmission.HAND, *transmission.JOINT, *transmission.ACTUATOR, *transmission.COUPLING}
    keys |= {*transmission.PAD, *transmission.HALL}
    assert not [key for key in sorted(keys) if f"`{key}`" not in page]
    for table in transmission.TABLES:
        assert re.search(rf"`\[+{table}\]+`", page), table


def test_tables_fit_on_a_page() -> None:
    """At most eight columns, of benchmarks too."""
    rules = re.compile(r"^\|(?:\s*:?-+:?\s*\|)+\s*$", re.MULTILINE)
    wide = {
        str(page.relative_to(DOCS)): rule.count("|") - 1
        for page in DOCS.rglob("*.md")
        for rule in rules.findall(page.read_text(encoding="utf-8"))
        if rule.count("|") > 9
    }
    assert not wide
