"""What the pages' text must keep: what they name is there, what is there is named, tables fit on a page."""

import dataclasses
import re
from pathlib import Path

from torch_ekm.description import transmission
from torch_ekm.simulation import PRESETS, PlantParameters

DOCS = Path(__file__).parents[2] / "docs"
PACKAGE = DOCS.parent / "torch_ekm"


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


def test_the_walks_through_the_code_name_what_is_there() -> None:
    """Each file of architecture.md exists, and holds the names that stand in brackets behind it."""
    page = (DOCS / "development" / "architecture.md").read_text(encoding="utf-8")
    walks, wrong = page.partition("## Packages")[0], []
    found = re.findall(r"`([a-z_/]+\.py)`(?: \(`(\w+)`\))?", walks)
    assert len(found) > 30
    for path, name in found:
        file = next((one / path for one in (PACKAGE, PACKAGE.parent) if (one / path).is_file()), None)
        if file is None or name not in file.read_text(encoding="utf-8"):
            wrong.append(f"{path} ({name})")
    assert not wrong


def test_change_tasks_name_files_that_exist() -> None:
    """Each change in CONTRIBUTING.md says where it is made, and names an example or a test of its kind."""
    text = (DOCS.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    tasks = text.partition("## Change tasks")[2].partition("## Add a learner")[0]
    named = [name for name in re.findall(r"`([\w/.]+)`", tasks) if "/" in name and "NAME" not in name]
    assert len(named) > 20
    assert not [name for name in named if not (DOCS.parent / name).exists() and ".venv" not in name]


def test_the_glossary_is_short() -> None:
    """At most sixty terms, in their order."""
    page = (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^([^\s`#{][^\n]*)\n  \S", page, re.MULTILINE)
    assert 20 < len(terms) <= 60
    assert terms == sorted(terms, key=str.lower)


def test_every_departure_and_preset_of_the_simulator_is_named() -> None:
    text = (DOCS / "explanation" / "simulator.md").read_text(encoding="utf-8")
    for name in (*(item.name for item in dataclasses.fields(PlantParameters)), *PRESETS):
        assert f"`{name}`" in text, name
