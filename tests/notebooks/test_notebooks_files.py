"""The notebooks as files: complete, without stray outputs, and there for those without a checkout."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.exceptions import DescriptionError
from torch_ekm.experiments.reporting.notebook import (
    copy_notebooks,
    notebook_folder,
    smoke_mode,
)
from torch_ekm.experiments.reporting.report import Table

NAMES = sorted(path.name for path in notebook_folder().glob("*.ipynb"))
EVIDENCE = ("04_", "05_", "06_")  # their outputs are kept


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_kept_only_where_they_are_the_evidence(name: str) -> None:
    notebook = json.loads((notebook_folder() / name).read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    if name.startswith(EVIDENCE):
        kinds = {output["output_type"] for cell in code for output in cell["outputs"]}
        assert "display_data" in kinds or "execute_result" in kinds
        assert "error" not in kinds
    else:
        assert not any(cell["outputs"] for cell in code)


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_comes_early(name: str) -> None:
    cells = json.loads((notebook_folder() / name).read_text(encoding="utf-8"))["cells"]
    assert cells[0]["cell_type"] == "markdown"
    assert "".join(cells[0]["source"]).startswith(f"# {int(name[:2])}. ")
    early = "".join("".join(cell["source"]) for cell in cells[:7])
    assert "plot" in early or "view(" in early


def test_copies(tmp_path: Path) -> None:
    copies = copy_notebooks(tmp_path / "new" / "folder")
    assert [copy.name for copy in copies] == NAMES
    assert copies[0].read_bytes() == (notebook_folder() / NAMES[0]).read_bytes()
    copies[0].write_text("mine now")
    with pytest.raises(DescriptionError, match="would be overwritten"):
        copy_notebooks(tmp_path / "new" / "folder")
    assert copies[0].read_text() == "mine now"
    copy_notebooks(tmp_path / "new" / "folder", overwrite=True)
    assert copies[0].read_text() != "mine now"
    (tmp_path / "file").write_text("x")
    with pytest.raises(DescriptionError, match="name a folder"):
        copy_notebooks(tmp_path / "file")


def test_command_lists_and_copies(tmp_path: Path) -> None:
    listed = CliRunner().invoke(app, ["notebooks"])
    assert [Path(line).name for line in listed.output.splitlines()] == NAMES
    copied = CliRunner().invoke(app, ["notebooks", "--copy", str(tmp_path)])
    assert copied.exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == NAMES


def test_smoke_mode_is_switched_on_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in (("1", True), ("0", False), ("", False)):
        monkeypatch.setenv("TORCH_EKM_SMOKE", value)
        assert smoke_mode() is expected
    monkeypatch.delenv("TORCH_EKM_SMOKE")
    assert smoke_mode() is False


def test_tables_are_escaped() -> None:
    page = Table("a", "x < y", ["<b>"], [["1 & 2"]])._repr_html_()
    assert "x &lt; y" in page
    assert "&lt;b&gt;" in page
    assert "1 &amp; 2" in page
