"""The notebooks as files: complete, without stray outputs, and there for those without a checkout."""

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest
from smoke import small

from torch_ekm.cli.describe import copy_notebooks, notebook_folder
from torch_ekm.exceptions import DescriptionError
from torch_ekm.experiments.reporting.plots import new_figure
from torch_ekm.experiments.reporting.report import Table

NAMES = sorted(path.name for path in notebook_folder().glob("*.ipynb"))
LARGEST = 600_000  # bytes of a stored notebook: it is read where it lies, and is a page of the site


def cells_of(name: str) -> list[dict[str, Any]]:
    """Cells of a notebook."""
    return json.loads((notebook_folder() / name).read_text(encoding="utf-8"))["cells"]


def outputs_of(cell: dict[str, Any]) -> list[dict[str, Any]]:
    """Outputs of a cell; those of text have none."""
    return cell.get("outputs", [])


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_stored(name: str) -> None:
    assert (notebook_folder() / name).stat().st_size < LARGEST
    code = [cell for cell in cells_of(name) if cell["cell_type"] == "code"]
    numbers = [cell["execution_count"] for cell in code]
    assert numbers == list(range(1, len(code) + 1))  # in one go, from top to bottom
    for output in (output for cell in code for output in outputs_of(cell)):
        assert output["output_type"] != "error"
        assert output.get("name") != "stderr", output["text"]
        assert not any("widget" in kind for kind in output.get("data", {}))
        text = json.dumps(output)
        assert "/tmp/" not in text
        assert "/home/" not in text


def test_smallest_sizes_replace_what_notebooks_hold() -> None:
    assert all(small(notebook_folder() / name) for name in NAMES)  # a ValueError names what is not there


@pytest.mark.parametrize("name", NAMES)
def test_it_opens_with_a_picture(name: str) -> None:
    first = cells_of(name)[:3]
    texts = ["".join(cell["source"]) for cell in first]
    assert texts[0].startswith(f"# {int(name[:2])}. ")
    kinds = {kind for cell in first for output in outputs_of(cell) for kind in output.get("data", {})}
    assert "image/png" in kinds
    assert any("\nYou learn " in text for text in texts)


def test_the_package_draws_in_its_style_and_leaves_the_others_alone() -> None:
    before = dict(plt.rcParams)
    figure, axes = new_figure(4.0, 3.0, columns=2)
    assert not any(axis.spines["top"].get_visible() for axis in axes)
    assert figure.get_layout_engine() is not None
    assert dict(plt.rcParams) == before
    with plt.style.context("torch_ekm.style"):  # by its name, as notebooks use it
        assert plt.rcParams["svg.hashsalt"] == "torch_ekm"


def test_copies(tmp_path: Path) -> None:
    copies = copy_notebooks(tmp_path / "new" / "folder")
    assert [copy.name for copy in copies] == NAMES
    assert copies[0].read_bytes() == (notebook_folder() / NAMES[0]).read_bytes()
    copies[0].write_text("mine now")
    with pytest.raises(DescriptionError, match="would be overwritten"):
        copy_notebooks(tmp_path / "new" / "folder")
    assert copies[0].read_text() == "mine now"
    (tmp_path / "file").write_text("x")
    with pytest.raises(DescriptionError, match="name a folder"):
        copy_notebooks(tmp_path / "file")


def test_tables_are_escaped() -> None:
    page = Table("a", "x < y", ["<b>"], [["1 & 2"]])._repr_html_()
    assert "x &lt; y" in page
    assert "&lt;b&gt;" in page
    assert "1 &amp; 2" in page
