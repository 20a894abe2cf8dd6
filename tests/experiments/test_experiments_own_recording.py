"""A recording of one's own: columns become motions, and motions what the model left over."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm.exceptions import DescriptionError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.experiments.learner_comparison.recordings import load_recording
from torch_ekm.experiments.learner_comparison.run import compare
from torch_ekm.experiments.learner_comparison.stream import Columns, load_own

COLUMNS = Columns(state=["angle", "extra*"], command=["rate"], observation=["angle"])


def pendulum(path: Path, n: int = 200) -> tuple[Path, np.ndarray]:
    """An angle that follows its commanded rate 20 % too fast and sags with its sine [rad, rad/s at 10 Hz]."""
    random = np.random.default_rng(5)
    rate = np.repeat(random.uniform(-1, 1, n // 5), 5)
    angle = np.zeros(n)
    for t in range(n - 1):
        angle[t + 1] = angle[t] + 0.1 * (1.2 * rate[t] - 0.5 * np.sin(angle[t]))
    table = np.column_stack([angle, rate, np.ones(n), np.arange(n)])
    np.savetxt(path, table, delimiter=",", header="angle,rate,extra a,extra b", comments="")
    return path, table


def servo(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """The rate, over the 0.1 s of a row."""
    return 0.1 * command


def test_motions_are_what_the_model_left_over(tmp_path: Path) -> None:
    path, table = pendulum(tmp_path / "own.csv")
    own = load_own(path, COLUMNS, servo)
    assert own.x.shape[1] == 4  # angle, extra a, extra b, rate
    angle, rate = table[:-1, 0], table[:-1, 1]
    assert own.y[:, 0].numpy() == pytest.approx(0.02 * rate - 0.05 * np.sin(angle))
    alone = load_own(path, COLUMNS)
    assert alone.y[:, 0].numpy() == pytest.approx(np.diff(table[:, 0]))
    assert "nothing moves" in alone.about


def test_what_a_learner_would_have_gained(tmp_path: Path) -> None:
    own = load_own(pendulum(tmp_path / "own.csv")[0], COLUMNS, servo)
    stream = own.stream()
    assert float(stream.y[:20].std(correction=0)) == pytest.approx(1.0)
    report = compare(stream, ("model alone", "SOGP default"))
    assert report.scores["own", "model alone"].rms.mean == pytest.approx(1.0, abs=1e-5)
    assert report.scores["own", "SOGP default"].rms.mean < 0.4


def test_increments_from_the_command_line(tmp_path: Path) -> None:
    path, _ = pendulum(tmp_path / "own.csv")
    given = load_own(path, Columns(["angle", "rate"], [], ["angle"])).stream(150)
    read = load_recording(path, 150, ["angle"], inputs=["angle", "rate"])
    assert torch.equal(read.y, given.y)
    assert len(read) == 150


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    path, _ = pendulum(tmp_path / "own.csv")
    with pytest.raises(UnknownNameError, match="extra b"):
        load_own(path, Columns(["angel"], ["rate"], ["angle"]))
    with pytest.raises(ShapeError, match="model"):
        load_own(path, COLUMNS, lambda s, u: s)
    with pytest.raises(DescriptionError, match="it has 29 motions"):
        load_own(pendulum(tmp_path / "short.csv", 30)[0], COLUMNS)
    with pytest.raises(ParameterError, match="clock"):
        load_own(tmp_path, COLUMNS)
