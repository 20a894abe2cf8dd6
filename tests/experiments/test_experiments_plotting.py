"""Figures show what the tables say."""

import numpy as np
from made_up_sessions import frame, turn

from torch_ekm.experiments.reporting.plots import plot_steady_state_error


def test_a_lost_object_does_not_hide_the_others() -> None:
    calm = np.linspace(0.8, 1.2, 20).tolist()
    lost = [*calm[:19], 38.0]
    of = [(23.0, calm), (38.0, lost)]
    turns = frame(turn(error=error, angle_deg=angle) for angle, errors in of for error in errors)
    (axis,) = plot_steady_state_error(turns).axes
    assert axis.get_ylim()[1] < 2.0
    crosses = [line for line in axis.lines if line.get_marker() == "x"]
    assert sum(len(line.get_xdata()) for line in crosses) == 1
    assert [label.get_text() for label in axis.get_xticklabels()] == ["23", "38"]
    assert axis.get_title(loc="left") == "box"
    (plain,) = plot_steady_state_error(turns[turns["error_deg"] < 2]).axes
    assert plain.get_ylim()[1] > 1.2  # nothing lost: the whole range, no crosses
    assert all(len(line.get_xdata()) == 0 for line in plain.lines if line.get_marker() == "x")


def test_every_object_has_a_panel_of_its_own() -> None:
    items = ("box", "weighted_box", "can", "bottle")
    turns = frame(turn(object=item, angle_deg=a) for item in items for a in (5.0, 9.0))
    panels = plot_steady_state_error(turns).axes
    assert [axis.get_title(loc="left") for axis in panels[:4]] == ["box", "weighted box", "can", "bottle"]
    assert [axis.axison for axis in panels] == [True] * 4 + [False] * 2
