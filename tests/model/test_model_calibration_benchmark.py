"""A simulated hand whose every figure is off is calibrated from its motions."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("sapien")
pytest.importorskip("coal")


@pytest.mark.slow
def test_four_motions_find_the_figures_of_a_wrong_hand():
    from calibration import trial

    outcome, calibration = trial(0, count=4)
    assert len(outcome.sure["moment_arms"]) >= 8  # of 10
    assert np.median(outcome.sure["moment_arms"]) < 0.02  # measured 0.0006
    assert np.median(outcome.sure["springs"]) < 0.05
    assert outcome.ratio < 0.3
    (row,) = (row for row in calibration.parameters if row.label == "spring of ring_1")
    assert not row.identifiable  # a finger that touches nothing
