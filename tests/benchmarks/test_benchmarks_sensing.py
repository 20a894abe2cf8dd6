"""The paper's sensing, in simulation: that a reading can be replaced by the truth, and that it runs."""

from pathlib import Path

import matrix
from questions import QUESTIONS


def test_what_each_reading_is_worth(tmp_path: Path) -> None:
    words = ["--seeds", "1:2", "--objects", "box", "--contenders", "all sensed;true joint angles"]
    asked = matrix.replace(QUESTIONS["sensing"], options=QUESTIONS["sensing"].short)
    made = matrix.ask(asked, [*words, "--jobs", "1", "--out", str(tmp_path)])
    rows = {text[0]: text[1:] for text in made.tables[0].text()}
    assert 0.05 < float(rows["all sensed"][5]) < 2.0  # [deg] of joints
    assert float(rows["true joint angles"][5]) == 0.0
    assert 0.01 < float(rows["all sensed"][6]) < 3.0  # [deg] of motors
