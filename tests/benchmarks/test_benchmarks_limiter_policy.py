"""A policy for the length of a step: the hand without an engine, what is chosen, rewarded and counted."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("limiter_policy", reason="the benchmarks are not part of this installation")
pytest.importorskip("sapien")

import limiter_policy
import step_policy
from limiter_policy import PAPER, POLICY, Outcome
from model_rig import DRAWN, ModelBench, drawn_plant
from step_policy import LONGEST, SHORTEST, TargetSteps, asked_of, share_of

from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.trials import trial_frame
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import PRESETS

DEG = np.pi / 180


@pytest.fixture(scope="module")
def env() -> TargetSteps:
    return TargetSteps(("box",))


def test_the_hand_moves_as_its_true_model_predicts() -> None:
    """And not as the one that is described, whose pulleys are smaller."""
    bench = ModelBench(Setting(plant=PRESETS["none"].replace(moment_arm=1.4)), "box", "KM")
    start = bench.grasp(3, 0)
    assert start is not None
    increment = torch.zeros(bench.model.hand.n_a, dtype=torch.float64)
    increment[bench.model.hand.actuator_names.index("index_proximal")] = 0.2 * DEG
    truth, described = KinematicModel(*bench.hand.true_descriptions()), bench.model
    force = bench.hand.observe().fingertip_force
    came = bench.plant.command(increment).state.minus(start)
    right, wrong = (
        model.linearize(start, fingertip_force=force).step(increment) for model in (truth, described)
    )
    size = float(came.norm())
    assert float((came - right).norm()) < 0.03 * size
    assert float((came - wrong).norm()) > 0.1 * size
    again = bench.grasp_again()
    assert float(again.minus(start).abs().max()) < 1e-12
    bench.close()


def test_hands_for_training_lie_between_two_presets() -> None:
    drawn = [drawn_plant(np.random.default_rng(seed)) for seed in range(20)]
    assert len({plant.hardware_seed for plant in drawn}) == 20
    for name in DRAWN:
        low, high = sorted(getattr(PRESETS[one], name) for one in ("none", "hostile"))
        values = [getattr(plant, name) for plant in drawn]
        assert low <= min(values) < low + 0.3 * (high - low)
        assert high >= max(values) > high - 0.3 * (high - low)


@pytest.mark.parametrize("action", [1.0, -1.0])
def test_an_action_is_the_length_of_the_step(env: TargetSteps, action: float) -> None:
    first, _ = env.reset(seed=4)
    assert env.observation_space.contains(first)
    then, reward, over, _, _ = env.step(np.array([action], np.float32))
    assert not over
    assert reward == pytest.approx(-0.1)
    assert then[2] == pytest.approx(share_of(action))
    turned = 10 * (first[0] - then[0])
    assert turned == pytest.approx(LONGEST * share_of(action), abs=2.5 if action > 0 else 1.0)
    assert share_of(-1.0) == SHORTEST
    assert share_of(1.0) == 1.0


def test_a_turn_that_is_abandoned_leaves_no_thread(env: TargetSteps) -> None:
    before = threading.active_count()
    first, _ = env.reset(seed=4)
    again, _ = env.reset(seed=4)
    env.close()
    assert threading.active_count() <= before
    np.testing.assert_array_equal(first, again)


def test_the_end_of_a_turn_is_rewarded() -> None:
    env = TargetSteps(("box",))
    env.reset(seed=4)
    total, over, info = 0.0, False, {}
    while not over:
        _, reward, over, _, info = env.step(np.array([0.0], np.float32))
        total += reward
    assert info["reached"]
    assert not info["lost"]
    assert total == pytest.approx(-0.1 * info["motions"])


def test_a_policy_is_asked_at_an_error_and_margins() -> None:
    assert asked_of(lambda _: 1.0, 25.0, 1.0, 0.0) == LONGEST
    assert asked_of(lambda _: -1.0, 3.0, 1.0, 0.0) == pytest.approx(3 * SHORTEST)
    assert asked_of(lambda features: float(features[6]), 3.0, 1.0, -0.5) == pytest.approx(3 * share_of(-0.5))


def record(system: str, angle: float, motions: int, reason: str = "reached") -> TrialRecord:
    errors = (angle, *np.linspace(angle, 0.1, motions))
    usual = {"step_error_deg": None, "first_step_deg": None, "message": "", "off_rotation_deg": 0.0}
    names = [f"{true}prediction_{name}_deg" for true in ("", "true_") for name in ("km", "ekm")]
    return TrialRecord(
        "box", "turn", "E-KM", 0, int(angle), angle, reason=reason, true_error_deg=0.2, errors_deg=errors,
        seconds=(0.0,) * motions, **usual, **dict.fromkeys(names, ()),
    )  # fmt: skip


def test_turns_that_both_reached_are_compared() -> None:
    made = {
        "a": [record(POLICY, 9, 4), record(POLICY, 19, 6), record(POLICY, 27, 5, "object lost")],
        "b": [record(PAPER, 9, 8), record(PAPER, 19, 12), record(PAPER, 27, 30)],
    }
    trials = trial_frame(made, 60)
    trials["place"], trials["system"] = "sapien", trials["job"].map({"a": POLICY, "b": PAPER})
    turns = [{"decision": 5 * k, "motions": 5, "lost": False, "reached": True} for k in range(9)]
    outcome = Outcome(trials, {"turns": turns})
    assert outcome.ratio("sapien", PAPER) == pytest.approx(0.5)
    rows = {row[0]: row[1:] for row in outcome.table("sapien", "simulated", "").text()}
    assert rows[POLICY] == ["3", "1", "2", "5.0", "5.0", "9.13", "1 object lost"]
    assert rows[PAPER][:4] == ["3", "0", "3", "16.7"]
    outcome.picture()


def test_a_quick_run_trains_and_prints_its_verdict(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("stable_baselines3", reason="extra rl")
    monkeypatch.setattr(limiter_policy, "WARM_UP", 0)
    monkeypatch.setattr(limiter_policy, "ANGLES", (5.0,))
    monkeypatch.setattr(limiter_policy, "SYSTEMS", {PAPER: "k", POLICY: "r"})
    monkeypatch.setattr(step_policy, "SIZES", (5.0, 6.0))
    words = ["--quick", "--seeds", "6:7", "--jobs", "1", "--out", str(tmp_path)]
    limiter_policy.main(words)
    first = capsys.readouterr().out.splitlines()[-1]
    assert first.startswith("policy lost 0 of 1, ")
    kept = {path: path.stat().st_mtime_ns for path in [*tmp_path.glob("*.zip"), *tmp_path.glob("box_*.json")]}
    assert len(kept) == 5
    limiter_policy.main(words)
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
