"""From records to claims: losses stay visible, pairs stay pairs, intervals cover."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.experiments.protocols.object_memory import judge_assignment
from torch_ekm.experiments.reporting.learning_tables import learning_table, prediction_curves
from torch_ekm.experiments.reporting.statistics import (
    bootstrap_ratio,
    compare,
    mean_prediction,
    paired_means,
    rate,
    recovery_trials,
    select,
    settle_steps,
    steady_state_error,
    survivor_error,
    unit_means,
)
from torch_ekm.experiments.reporting.tables import (
    comparison_table,
    controller_table,
    object_table,
    reason_table,
)
from torch_ekm.experiments.reporting.targets import (
    adapt_targets,
    generalize_targets,
    goal,
    online_targets,
)


def record(controller: str = "KM", seed: int = 0, error: float = 1.0, **changes: object) -> dict:
    base = {
        "controller": controller, "seed": seed, "trial": 1, "object": "box", "kind": "turn",
        "angle_deg": 20.0, "grasped": True, "reason": "reached", "lost": False, "true_error_deg": error,
        "steady_state_error_deg": error,
        "steps": 3, "errors_deg": [20.0, 8.0, 0.4, 0.3], "first_step_deg": 0.5, "step_error_deg": 0.4,
        "off_rotation_deg": 1.0, "seconds": [0.01] * 3, "prediction_km_deg": [0.6, 0.4],
        "prediction_ekm_deg": [0.3, 0.1], "true_prediction_km_deg": [0.5, 0.5],
        "true_prediction_ekm_deg": [0.1, 0.1],
    }  # fmt: skip
    return {**base, **changes}


def test_lost_object_counts_with_the_whole_angle() -> None:
    lost = record(error=3.0, lost=True, reason="object lost")
    assert steady_state_error(lost) == 20.0
    assert survivor_error(lost) is None
    assert steady_state_error(record(error=3.0)) == 3.0


@pytest.mark.parametrize(
    ("errors", "expected"),
    [([3, 0.4, 0.3], 1), ([3, 0.4, 0.9, 0.2], 3), ([0.2, 0.1], 0), ([3, 2, 0.6], 40)],
)
def test_settling_means_staying_inside(errors: list[float], expected: int) -> None:
    assert settle_steps(record(errors_deg=errors)) == expected


def test_lost_objects_never_settle() -> None:
    assert settle_steps(record(errors_deg=[3, 0.1], lost=True), limit=25) == 25


def test_units_are_objects_and_seeds_and_pairs_need_both() -> None:
    ours = [record("E-KM", 0, 1.0), record("E-KM", 0, 3.0), record("E-KM", 1, 5.0), record("E-KM", 2, 7.0)]
    theirs = [record("KM", 1, 10.0), record("KM", 0, 4.0)]
    assert unit_means(ours, steady_state_error) == {("box", 0): 2.0, ("box", 1): 5.0, ("box", 2): 7.0}
    a, b = paired_means(ours, theirs, steady_state_error)
    np.testing.assert_array_equal(a, [2.0, 5.0])
    np.testing.assert_array_equal(b, [4.0, 10.0])


def test_what_was_not_grasped_is_not_measured_but_counted() -> None:
    failed = {"controller": "KM", "seed": 3, "object": "box", "kind": "turn", "grasped": False,
              "reason": "not grasped", "lost": False}  # fmt: skip
    assert select([failed, record()], controller="KM") == [record()]
    row = reason_table([failed, record()]).rows[0]
    assert row[0] == "KM"
    assert row[-1] == "1"


def test_mean_prediction_picks_the_right_list() -> None:
    assert mean_prediction("km")(record()) == 0.5
    assert mean_prediction("ekm")(record()) == pytest.approx(0.2)
    assert mean_prediction("true_km")(record()) == 0.5
    assert mean_prediction("true_ekm")(record()) == pytest.approx(0.1)
    assert mean_prediction("ekm")(record(prediction_ekm_deg=[None])) is None


def test_bootstrap_ratio_covers_the_truth() -> None:
    generator = np.random.default_rng(0)
    hits = 0
    for trial in range(60):
        theirs = generator.uniform(1, 3, size=25)
        ours = 0.4 * theirs * generator.uniform(0.7, 1.3, size=25)
        found = bootstrap_ratio(ours, theirs, seed=trial, resamples=500)
        hits += found.low <= 0.4 <= found.high
    assert hits >= 51  # 95 % of 60 is 57; fewer than 51 has a chance of 1 %
    theirs = generator.uniform(1, 3, size=25)
    paired = bootstrap_ratio(0.4 * theirs, theirs)  # pairs stay together: nothing is left to chance
    assert paired.high - paired.low < 1e-9
    with pytest.raises(ShapeError):
        bootstrap_ratio(np.ones(3), np.ones(4))
    with pytest.raises(ParameterError):
        bootstrap_ratio(np.ones(3), np.zeros(3))


def test_rates_have_wilsons_interval() -> None:
    found = rate([True] + [False] * 19)
    # Wilson (1927) for 1 of 20 at 95 %
    assert (found.count, found.n) == (1, 20)
    assert found.low == pytest.approx(0.00888, abs=1e-4)
    assert found.high == pytest.approx(0.23613, abs=1e-4)
    assert rate([]).n == 0
    assert compare(np.ones(1), np.ones(1)) is None


def test_recovery_counts_from_the_trial_after_the_event() -> None:
    km, ekm = np.ones(8), np.array([0.2, 0.2, 2.0, 0.8, 0.4, 0.2, 0.2, 0.2])
    assert recovery_trials(ekm, km, event=3) == 2
    assert recovery_trials(ekm, km, event=1) == 1
    assert recovery_trials(np.ones(8), km, event=3) is None


def test_object_table_shows_means_ratios_and_losses() -> None:
    records = [record("KM", seed, 2.0 + seed) for seed in range(4)]
    records += [record("E-KM", seed, 0.5 + 0.25 * seed) for seed in range(4)]
    records[0] = record("KM", 0, 2.0, lost=True, reason="object lost")
    table = object_table(records)
    row = dict(zip(table.header, table.rows[0], strict=True))
    assert row["KM [deg]"].startswith("8.00 [")  # (20 + 3 + 4 + 5) / 4
    assert row["E-KM [deg]"].startswith("0.88 [")
    assert row["E-KM:KM [%]"].startswith("11 [")
    assert (row["KM lost"], row["E-KM lost"]) == ("1", "0")
    assert table.rows[-1][0] == "all"
    controllers = controller_table(records, limit=40)
    assert controllers.rows[0][:2] == ["KM", controllers.rows[0][1]]
    assert controllers.rows[0][2].startswith("4.00 [")  # survivors
    compared = comparison_table(records, limit=40)
    assert compared.rows[0][1].startswith("11 [")
    assert compared.rows[0][2] == "-"  # no KM+I in these records


def test_learning_table_finds_the_last_negative_result() -> None:
    generator = np.random.default_rng(0)
    records = []
    for trial in range(1, 25):
        ekm = 1.0 if trial <= 3 else 0.3
        noise = generator.normal(0, 0.05, size=2)
        records.append(
            record(
                "E-KM",
                0,
                trial=trial,
                prediction_km_deg=[1.0 + noise[0]],
                prediction_ekm_deg=[ekm + noise[1]],
            )
        )
    row = learning_table(records, events=(10, 24), trials=24).rows[0]
    assert 3 <= int(row[1]) <= 7
    assert 25 <= float(row[3]) <= 36  # trials 17 to 24 without 24
    assert row[4:] == ["1", "-"]  # after the last trial there is nothing to see
    curves = prediction_curves(records[:5], trials=6)
    assert np.isnan(curves[0][0][5])


def test_goals_say_by_how_much_they_are_missed() -> None:
    assert goal("x", 25, 20.0, " %")[-1] == "yes"
    assert goal("x", 25, 30.0, " %")[-1] == "no, by 5 %"
    assert goal("x", 90, 80.0, least=True)[-1] == "no, by 10"


def test_targets_of_each_experiment() -> None:
    records = []
    for seed in range(5):
        records += [record("KM", seed, 2.0 + 0.1 * seed), record("KM+I", seed, 0.3 + 0.01 * seed)]
        records.append(record("E-KM", seed, 0.2 + 0.01 * seed, first_step_deg=0.2))
    rows = {row[0]: row for row in generalize_targets(records, limit=40)}
    assert rows["steady-state error E-KM : KM, box"][-1] == "yes"
    assert rows["error of the first motion E-KM : KM+I"][2] == "40 %"
    assert rows["motions to settle E-KM : KM+I"][-1] == "no, by 40 %"
    assert rows["objects lost, E-KM"][2] == "0 %"
    assert rows["steady-state error of the KM"][-1] == "yes"
    turns = [record("E-KM", 0, trial=t) for t in range(1, 20)]
    assert any("after 16 trials" in row[0] for row in online_targets(turns, (10,), 19))
    memory = {name: [0.2] for name in ("bank", "labelled", "one model", "fresh")}
    adapted = [[record("E-KM", 0, model=0, memory_errors_deg=memory) for _ in range(5)]]
    assert adapt_targets(adapted)[0][2] == "100 %"


def test_assignment_gives_every_object_one_model_at_most() -> None:
    def turns(pairs: str) -> list[dict]:
        return [{"object": pair[0], "model": int(pair[1])} for pair in pairs.split()]

    perfect = judge_assignment(turns("a0 b1 a0 b1 a0 b1 a0 b1 a0 b1"))
    assert (perfect.right, perfect.judged, perfect.n_models) == (4, 4, 2)
    merged = judge_assignment(turns("a0 b0 a0 b0 a0 b0 a0 b0 a0 b0"))
    assert (merged.right, merged.judged) == (2, 4)  # one model cannot be both
    split = judge_assignment(turns("a0 a0 a0 a0 a1 a0"))
    assert (split.right, split.judged, split.n_models) == (2, 3, 2)
