"""Pages of measured figures: commands exist, what was measured is kept, and a page says how it was made."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

write_pages = pytest.importorskip("write_pages", reason="the benchmarks are not part of this installation")


def _plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    part = {"title": "A part", "command": command, "see": "Look.", "quick": "--quick"}
    monkeypatch.setattr(write_pages, "PLAN", {"one": {"title": "A page", "parts": [part]}})


def test_every_command_is_there() -> None:
    for name in write_pages.PLAN:
        for part in write_pages.parts_of(name):
            script = part.words(Path("out"), quick=True)[1]
            assert script.startswith("-") or Path(script).exists(), script
            assert part.see.endswith(".")


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


def test_half_a_result_of_another_commit_is_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "resume.py"
    script.write_text(
        "import pathlib, sys\n"
        "done = pathlib.Path(sys.argv[1]); done.mkdir(exist_ok=True)\n"
        "(done / 'report.md').write_text(f'# T\\n\\n{len(list(done.glob(\"run_*\")))} runs were there\\n')\n"
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
    assert "no page nothing; there are demo" in capsys.readouterr().err


def test_a_report_comes_with_its_headings_below_the_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "report.py"
    script.write_text(
        "import pathlib, sys\n"
        "out = pathlib.Path(sys.argv[1]); out.mkdir()\n"
        "(out / 'report.md').write_text('# Title\\n\\nAn answer.\\n\\n## A table\\n')\n"
    )
    _plan(tmp_path, monkeypatch, f"{script} {{out}}")
    write_pages.main(["one", "--quick", "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "one.md").read_text(encoding="utf-8")
    assert "# Title" not in text
    assert "An answer.\n\n### A table" in text
    assert sys.executable not in text


SCRIPTS = [path for path in write_pages.HERE.glob("**/*.py") if path.parent.name != "recorded_hand"]


@pytest.mark.parametrize("script", sorted(SCRIPTS), ids=lambda path: path.stem)
def test_every_script_can_be_imported(script: Path) -> None:
    """What nobody runs in a test still follows the package's names."""
    importlib.import_module(script.stem)
