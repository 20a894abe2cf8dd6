"""The learned correction of how normal forces answer to the actuators."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ekm.estimation.force_sensitivity import ForceSensitivity
from torch_ekm.exceptions import NonFiniteError, ShapeError

NAN = math.nan
F64 = torch.float64


def moves(n: int, n_a: int = 3, seed: int = 0) -> torch.Tensor:
    """Motions of 0.1 rad."""
    return 0.1 * torch.randn(n, n_a, dtype=F64, generator=torch.Generator().manual_seed(seed))


def taught(
    true: torch.Tensor, described: torch.Tensor, w: torch.Tensor, noise: float = 0.0
) -> ForceSensitivity:
    learner = ForceSensitivity(*true.shape)
    draw = torch.Generator().manual_seed(1)
    for one in w:
        error = noise * torch.randn(len(true), dtype=F64, generator=draw)
        learner.update(one, true @ one + error, described @ one, 0.0)
    return learner


def test_it_finds_what_the_description_gets_wrong() -> None:
    described, off = torch.full((2, 3), 10.0, dtype=F64), torch.tensor([[-15.0, 4.0, 0.0], [3.0, 0.0, -8.0]])
    learner = taught(described + off.double(), described, moves(60), noise=0.1)
    found = learner.corrected(described, [0, 1]) - described
    torch.testing.assert_close(found, off.double(), atol=1.5, rtol=0)


def test_it_scales_what_a_stiffer_description_says_everywhere() -> None:
    """S changes from state to state, and the hand presses .4 as hard as it says."""
    learner, draw = ForceSensitivity(1, 3), torch.Generator().manual_seed(2)
    for w in moves(40):
        S = 20 * torch.randn(1, 3, dtype=F64, generator=draw)
        learner.update(w, 0.4 * S @ w, S @ w, 0.0)
    S = torch.tensor([[10.0, -20.0, 5.0]], dtype=F64)
    assert float(learner.scale) == pytest.approx(0.4, abs=0.03)
    torch.testing.assert_close(learner.corrected(S, [0]), 0.4 * S, atol=1.0, rtol=0)


def test_motions_in_one_direction_do_not_fade_what_others_said() -> None:
    true, described = torch.tensor([[5.0, -3.0, 2.0]], dtype=F64), torch.zeros(1, 3, dtype=F64)
    learner = taught(true, described, moves(30))
    one = torch.tensor([0.1, 0.0, 0.0], dtype=F64)
    before = learner.evidence.clone()
    for _ in range(300):
        learner.update(one, true @ one, described @ one, 0.0)
    assert float(learner.evidence[0, 2, 2]) > 0.5 * float(before[0, 2, 2])
    torch.testing.assert_close(learner.correction, true, atol=0.5, rtol=0)


def test_a_pad_that_does_not_measure_learns_nothing_and_a_slip_little() -> None:
    true, described = torch.full((2, 3), 5.0, dtype=F64), torch.zeros(2, 3, dtype=F64)
    learner = taught(true, described, moves(30))
    before = learner.correction.clone()
    w = moves(1, seed=5)[0]
    r = learner.update(w, torch.tensor([NAN, float(true[1] @ w)], dtype=F64), described @ w, 0.0)
    assert math.isnan(float(r[0]))
    assert torch.equal(learner.correction[0], before[0])
    learner.update(w, true @ w - 50.0, described @ w, 0.0)  # it lets go
    assert float((learner.correction - before).abs().max()) < 10.0


def test_bad_input_changes_nothing_and_the_state_dict_carries_all(unchecked) -> None:
    true, described = torch.full((2, 3), 5.0, dtype=F64), torch.zeros(2, 3, dtype=F64)
    learner, nothing = taught(true, described, moves(5)), torch.zeros(2, dtype=F64)
    kept = {name: value.clone() for name, value in learner.state_dict().items()}
    with pytest.raises(ShapeError, match="change"):
        learner.update(moves(1)[0], torch.zeros(3, dtype=F64), nothing, 0.0)
    with pytest.raises(NonFiniteError, match="moved"):
        learner.update(torch.full((3,), NAN, dtype=F64), torch.zeros(2, dtype=F64), nothing, 0.0)
    with pytest.raises(NonFiniteError, match="way"):
        learner.update(moves(1)[0], nothing, nothing, NAN)
    learner.update(torch.zeros(3, dtype=F64), nothing, nothing, 0.0)  # nothing moved
    assert all(torch.equal(value, kept[name]) for name, value in learner.state_dict().items())
    other = ForceSensitivity(2, 3)
    of_a_file = {**kept, "variance": torch.full((2,), 0.25**2, dtype=F64)}  # of a smaller noise
    assert not other.state_problems(of_a_file)
    other.load_state_dict(kept)
    for each in (learner, other):
        each.update(moves(1, seed=9)[0], torch.ones(2, dtype=F64), nothing, 0.1)
    assert torch.equal(other.correction, learner.correction)


def test_what_is_lost_as_the_object_turns_either_way_is_no_answer_to_the_actuators() -> None:
    """6 N a radian, of turns to and fro whose answers cancel."""
    true, learner = torch.tensor([[5.0, -3.0, 2.0]], dtype=F64), ForceSensitivity(1, 3)
    for k, one in enumerate(moves(60)):
        way = 0.05 + 0.2 * (k % 3)
        learner.update(one, true @ one - 6.0 * way, torch.zeros(1, dtype=F64), way)
    assert float(learner.by_way) == pytest.approx(-6.0, abs=0.3)
    torch.testing.assert_close(learner.correction, true, atol=0.5, rtol=0)
    still, w = torch.zeros(1, dtype=F64), torch.zeros(3, dtype=F64)
    assert float(learner.spread(w, still, 0.0)) == pytest.approx(float(learner.variance.sqrt()))
    assert float(ForceSensitivity(1, 3).spread(w, still, 0.5)) == pytest.approx(math.hypot(0.3, 0.3 * 5.0))
