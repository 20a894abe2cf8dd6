"""The reach of a grasp to look at."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.exceptions import ParameterError
from torch_ekm.inspection.viewer.reach import ReachShow
from torch_ekm.inspection.viewer.serve import choose_show

pytest.importorskip("viser")
pytest.importorskip("sapien")


class Gui:
    """Stands for viser's panel."""

    def add_slider(self, label, *, min, max, step, initial_value):
        self.slider = SimpleNamespace(value=initial_value, low=min, high=max)
        return self.slider

    def add_markdown(self, content):
        self.note = content


def test_the_slider_turns_the_object_and_the_note_says_what_ends_it() -> None:
    show, gui = ReachShow("icub_right", "tea_tin"), Gui()
    show.add_controls(gui)
    assert gui.slider.low < 0 < gui.slider.high
    assert "thumb_2" in gui.note
    assert show.update() is None
    gui.slider.value = gui.slider.high
    moved = show.update()
    assert moved is not None
    played = show.scene().transforms
    assert played.shape[1:] == (*moved.shape,)
    assert len(played) > len(show.path)  # to and fro
    assert np.allclose(played[0], moved)


def test_reach_is_printed_and_written(tmp_path) -> None:
    page = tmp_path / "reach.html"
    command = ["show", "icub_right", "--object", "tea_tin", "--reach", "--html", str(page)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "link: thumb_2" in result.output
    assert page.exists()
    with pytest.raises(ParameterError, match="without an object"):
        choose_show("icub_right", None, reach=True)
