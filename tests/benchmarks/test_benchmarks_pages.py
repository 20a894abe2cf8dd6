"""Pages of measured figures: commands exist, what was measured is kept, and a page says how it was made."""

import importlib
import math
import re
import sys
from pathlib import Path

import pytest
import write_pages
from dots import dot_chart
from write_pages import Section, page_text

from torch_ekm.experiments.reporting.plots import COLOURS
from torch_ekm.experiments.reporting.report import Table
from torch_ekm.experiments.reporting.statistics import Estimate


def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    part = {"title": "A part", "command": command, "see": "Look.", "quick": "--quick"}
    monkeypatch.setattr(write_pages, "PLAN", {"one": {"title": "A page", "parts": [part]}})


def test_every_command_is_there() -> None:
    for name in write_pages.PLAN:
        for part in write_pages.parts_of(name):
            script = part.words(Path("out"), quick=True)[1]
            assert script.startswith("-") or Path(script).exists(), script
            assert part.see.endswith((".", "?"))


def test_no_picture_of_a_page_is_written_over_by_another() -> None:
    for name in write_pages.PLAN:
        pictures = [part.picture for part in write_pages.parts_of(name) if part.picture]
        assert len(pictures) == len(set(pictures)), name


def test_a_page_keeps_what_was_measured_and_says_how(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "count.py"
    told = tmp_path / "told"
    script.write_text(
        "import pathlib, sys\n"
        f"path = pathlib.Path({str(told)!r})\n"
        "path.write_text(path.read_text() + 'x' if path.exists() else 'x')\n"
        "print('| a |\\n|---|\\n|', len(path.read_text()), sys.argv[1:], '|')\n"
    )
    _plan(tmp_path, monkeypatch, str(script))
    out = tmp_path / "out"
    write_pages.main(["one", "--quick", "--out", str(out)])
    first = (out / "one.md").read_text(encoding="utf-8")
    assert first.startswith("# A page\n")
    assert "| 1 ['--quick'] |" in first
    assert "commit" in first
    write_pages.main(["one", "--quick", "--keep", "--out", str(out)])
    assert told.read_text() == "x", "measured a second time"
    _plan(tmp_path, monkeypatch, f"{script} --other")
    write_pages.main(["one", "--quick", "--keep", "--out", str(out)])
    assert "| 2 ['--other', '--quick'] |" in (out / "one.md").read_text(encoding="utf-8")


def test_half_a_result_of_another_commit_is_not_gone_on_with(tmp_path, monkeypatch):
    script = tmp_path / "resume.py"
    script.write_text(  # the file of Report.write alone: its import would take seconds
        "import pathlib, sys\n"
        "done = pathlib.Path(sys.argv[1]); done.mkdir(exist_ok=True)\n"
        "summary = f'{len(list(done.glob(\"run_*\")))} runs were there'\n"
        "(done / 'report.md').write_text(summary)\n"
        "(done / 'run_1').touch()\n"
    )
    _plan(tmp_path, monkeypatch, f"{script} {{out}}")
    out = tmp_path / "out"
    for commit, there in (("old", 0), ("old", 1), ("new", 0), ("new", 1)):
        monkeypatch.setattr(write_pages, "commit", lambda commit=commit: commit)
        write_pages.main(["one", "--quick", "--out", str(out)])
        assert f"{there} runs were there" in (out / "one.md").read_text(encoding="utf-8")
        (out / "one" / "0" / "measured.json").unlink()  # as if it had been stopped


def test_an_unknown_page_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        write_pages.main(["nothing"])
    assert "no page nothing; there are paper" in capsys.readouterr().err


def test_a_report_comes_with_its_headings_below_the_pages(tmp_path, monkeypatch):
    script = tmp_path / "report.py"
    script.write_text(
        "import pathlib, sys\n"
        "from torch_ekm.experiments.reporting.report import FigureFile, Report, Table\n"
        "out = pathlib.Path(sys.argv[1]); out.mkdir(); (out / 'shown.svg').touch()\n"
        "table = Table('a', 'A table', ['a', 'c'], [[None, 0.5], ['1|2', '']], 'A note.')\n"
        "figures = [FigureFile('shown.svg', 'Seen.'), FigureFile('other.svg', 'Left out.')]\n"
        "Report('Title', 'An answer.', [table], figures).write(out)\n"
    )
    _plan(tmp_path, monkeypatch, f"{script} {{out}}")
    (part,) = write_pages.PLAN["one"]["parts"]
    part["picture"] = "shown"
    write_pages.main(["one", "--quick", "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "one.md").read_text(encoding="utf-8")
    assert "# Title" not in text
    assert "Look.\n\nAn answer.\n" in text
    assert "\n![Seen.](one/shown.svg)\n\n*Seen.*\n\n### A table\n\n| a | c |" in text
    assert "| - | 0.50 |\n| 1\\|2 |  |\n\nA note." in text
    assert "Left out" not in text
    assert (tmp_path / "out" / "one" / "shown.svg").exists()
    assert sys.executable not in text


def test_a_question_comes_first_and_long_tables_are_files() -> None:
    def table(rows: int) -> str:
        return "\n".join(["| a |", "|---|", *(f"| {k} |" for k in range(rows))])

    picture = "![Seen.](a.svg)\n\n*Seen.*"
    body = f"Answer.\n\n{picture}\n\n### Short\n\n{table(8)}\n\nNote.\n\n### Other\n\n{table(2)}\n\nIts note."
    files: dict[str, list[list[str]]] = {}
    part = Section("Part", "See.", body, "`run`: commit 1.", "a")
    text = page_text("Page", [part], ["By it."], "one", files)
    shown = [
        "See.",
        "Answer.",
        picture.replace("a.svg", "one/a.svg"),
        f"### Short\n\n{table(8)}\n\nNote.",
        "Tables: [Other](one/other.csv).",
    ]
    made = "## Commands and versions\n\n- Part: `run`: commit 1.\n\nBy it."
    assert text == "\n\n".join(["# Page\n\n## Part", *shown, made])
    assert files == {"other.csv": [["a"], ["0"], ["1"]]}
    long = page_text("Page", [Section("Part", "See.", table(9), "")] * 2, [], "one", files)
    assert "Tables: [Part](one/part.csv).\n" in long
    assert "Tables: [Part](one/part_2.csv).\n" in long
    assert len(files["part.csv"]) == 10


def test_tables_are_drawn_with_their_intervals() -> None:
    rows = [["plain", Estimate(1.0, 0.5, 2.0, 9), 0.1], ["other", None, math.nan], ["**ours**", 3.0, None]]
    made = Table("errors", "Errors", ["what", "KM [deg]", "time"], rows)
    (panel,) = dot_chart([made], ["KM [deg]"], "error [deg]").axes
    assert [text.get_text() for text in panel.get_yticklabels()] == ["plain", "other", "ours"]
    dots = [(line.get_color() == COLOURS["KM"], *line.get_xdata()) for line in panel.lines]
    assert dots == [(True, 1.0), (True, 0.5, 2.0), (False, 3.0)]  # blue: ours, in bold
    (both,) = dot_chart([made], ["KM [deg]", "time"], "").axes
    assert len({line.get_color() for line in both.lines}) == 2


def test_no_page_says_that_a_bar_is_met() -> None:
    pages = [*(write_pages.HERE.parent / "docs").rglob("*.md"), write_pages.HERE.parent / "README.md"]
    assert not [page.name for page in pages if re.search(r"\|\s*met\s*\|", page.read_text("utf-8"))]


SCRIPTS = [path for path in write_pages.HERE.glob("**/*.py") if path.parent.name != "recorded_hand"]


@pytest.mark.parametrize("script", sorted(SCRIPTS), ids=lambda path: path.stem)
def test_every_script_can_be_imported(script: Path) -> None:
    """What nobody runs in a test still follows the package's names."""
    importlib.import_module(script.stem)
