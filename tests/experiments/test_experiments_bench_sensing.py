"""Vision and Hall sensors in the loop."""

from __future__ import annotations

import pytest

from torch_ekm.experiments.bench import Bench
from torch_ekm.experiments.setting import Setting


def test_object_is_turned_with_camera_and_hall_sensors() -> None:
    pytest.importorskip("cv2")
    bench = Bench(Setting(sensing=True), "box", "E-KM")
    record = bench.trial(0, 0, 6.0)
    assert record["reason"] == "reached", record["message"]
    assert record["true_error_deg"] < 0.5  # truth is only looked at afterwards
