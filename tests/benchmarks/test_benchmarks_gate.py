"""The benchmark of the last gate, with 2,000 readings, and that it would see what it is to find."""

import gate
import pytest

from torch_ekm.plant import ServoInverse


def test_searched_faults_bring_no_command_above_the_increment_and_teach_nothing() -> None:
    count = gate.search(2000, each=250, seed=0)
    assert count.readings >= 2000
    assert count.commands > 1000
    assert (count.above, count.not_finite, count.outside, count.learned) == (0, 0, 0, 0)
    assert len(count.reasons) > 5  # faults of many kinds were found out


def test_a_loop_that_learns_from_a_refused_reading_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    send = ServoInverse.send_path

    def rash(self, path, watch, start, by):
        after = send(self, path, watch, start, by)
        self.learn(after)
        return after

    monkeypatch.setattr(ServoInverse, "send_path", rash)
    held = gate.grasp("icub_right", "box")
    count = gate.Count()
    monkeypatch.setattr(
        gate.Fault, "drawn", classmethod(lambda cls, draw: cls("a", "offset", 3, 0.5, 1, 0, 4, False))
    )
    with gate.refusals() as refused:
        gate.session(held, 0, 12, False, count, refused)
    assert count.learned > 0
