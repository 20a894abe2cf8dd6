"""Figures show what the tables say."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from torch_ekm.experiments.reporting.plots import plot_bank, plot_calibration, plot_steady_state_error

pytest.importorskip("matplotlib")


def test_a_lost_object_does_not_hide_the_others() -> None:
    calm = np.linspace(0.8, 1.2, 20)
    lost = np.append(calm[:19], 38.0)
    (axis,) = plot_steady_state_error({"KM": {"23": calm, "38": lost}}, "can").axes
    assert axis.get_ylim()[1] < 2.0
    crosses = [line for line in axis.lines if line.get_marker() == "x"]
    assert sum(len(line.get_xdata()) for line in crosses) == 1
    assert [text.get_text() for text in axis.texts] == [f"mean {lost.mean():.1f}"]
    assert "can" in axis.get_title(loc="left")
    (plain,) = plot_steady_state_error({"KM": {"23": calm, "38": calm}}).axes
    assert plain.get_ylim()[1] > 1.2  # nothing lost: the whole range, no crosses
    assert all(len(line.get_xdata()) == 0 for line in plain.lines if line.get_marker() == "x")


def test_a_probability_an_ulp_above_one_is_sure() -> None:
    (axis,) = plot_bank(["box"], [0], [[1.0 + 2.3e-16, 0.0]]).axes
    assert axis.lines[0].get_alpha() == 1.0


def test_a_calibration_is_drawn_with_its_standard_errors():
    row = SimpleNamespace(label="spring of knee", identifiable=True)
    found = SimpleNamespace(
        identifiable={"spring of knee": True, "spring of hip": False},
        parameters=(row, SimpleNamespace(label="spring of hip", identifiable=False)),
        x=np.array([0.5, 0.0]),
        covariance=np.diag([0.01, 1.0]),
        errors_before=np.full((3, 8), 0.02),
        errors_after=np.full((3, 8), 0.001),
    )
    left, right = plot_calibration(found).axes
    assert [text.get_text() for text in left.get_yticklabels()] == ["spring of knee"]
    before, after = right.get_lines()
    np.testing.assert_allclose(before.get_ydata(), np.degrees(0.02 * np.sqrt(3)))
    np.testing.assert_allclose(after.get_ydata(), np.degrees(0.001 * np.sqrt(3)))
