"""From records to claims: losses stay visible, pairs stay pairs, intervals cover; closed forms."""

import itertools
import json
import re

import numpy as np
import pandas
import pytest
import scipy.stats
from made_up_sessions import frame, not_grasped, turn

from torch_ekm.exceptions import StateError
from torch_ekm.experiments.protocols.generalize import significance_table
from torch_ekm.experiments.protocols.online import Online, learning, prediction_curves
from torch_ekm.experiments.records import NOT_GRASPED, TrialRecord
from torch_ekm.experiments.reporting.report import Column, Table
from torch_ekm.experiments.reporting.statistics import (
    Estimate,
    bootstrap_mean,
    bootstrap_ratio,
    estimate,
    learning_curve,
    paired_means,
    rate,
    select,
    unit_means,
)
from torch_ekm.experiments.reporting.tables import controller_table, error_table, ratio, reason_table, verdict

# -- records -----------------------------------------------------------------------------------------


def test_records_come_back_from_json_as_they_were() -> None:
    for record in (turn(first_step_deg=None), not_grasped()):
        assert TrialRecord.from_json(json.loads(json.dumps(vars(record)))) == record


def test_figures_that_a_record_does_not_have_are_refused() -> None:
    figures = dict(vars(turn()))
    with pytest.raises(StateError, match="surprise"):
        TrialRecord.from_json({**figures, "surprise": 1.0})
    del figures["off_rotation_deg"]
    with pytest.raises(StateError, match="off_rotation_deg"):
        TrialRecord.from_json(figures)


def test_a_lost_object_counts_with_the_whole_angle_whatever_stopped_the_loop() -> None:
    ends = {"object lost": 1.0, "pose jump": 76.0}
    records = [turn(error=3.0, reason=reason, off_rotation_deg=off) for reason, off in ends.items()]
    trials = frame([*records, turn(error=3.0), turn(error=3.0, reason="pose jump", off_rotation_deg=2.0)])
    assert trials["lost"].tolist() == [True, True, False, False]
    assert trials["not_reached"].tolist() == [False, False, False, True]
    assert trials["error_deg"].tolist() == [20.0, 20.0, 3.0, 3.0]


def test_units_are_objects_and_seeds_and_pairs_need_both() -> None:
    ours = [turn("E-KM", 0, 1.0), turn("E-KM", 0, 3.0), turn("E-KM", 1, 5.0), turn("E-KM", 2, 7.0)]
    theirs = [turn("KM", 1, 10.0), turn("KM", 0, 4.0)]
    means = unit_means(frame(ours), "error_deg")
    assert means.to_dict() == {("box", 0): 2.0, ("box", 1): 5.0, ("box", 2): 7.0}
    a, b = paired_means(frame(ours), frame(theirs), "error_deg")
    np.testing.assert_array_equal(a, [2.0, 5.0])
    np.testing.assert_array_equal(b, [4.0, 10.0])


def test_trials_without_a_value_are_left_out() -> None:
    trials = frame([turn(first_step_deg=None), turn(seed=1, first_step_deg=2.0)])
    assert unit_means(trials, "first_step_deg").to_dict() == {("box", 1): 2.0}
    assert estimate(trials[:1], "first_step_deg") is None


def test_what_was_not_grasped_is_not_measured_but_counted() -> None:
    trials = frame(
        [not_grasped(seed=3), turn(), turn(error=2.0, reason="stalled"), turn(reason="object lost")]
    )
    assert select(trials, controller="KM", reason="reached").index.tolist() == [1]
    assert len(select(trials)) == 3


def test_why_turns_ended_is_told_of_each_controller() -> None:
    records = [turn("KM", seed, 1.0, reason="stalled") for seed in range(3)] + [turn("E-KM", 0, 0.25)]
    records += [turn("E-KM", 1, 0.3, reason="object lost"), not_grasped("E-KM")]
    table = reason_table(frame(records))
    assert table.header == ["reason", "turns", "KM", "E-KM"]
    assert {row[0]: row[2:] for row in table.text()} == {
        "stalled": ["3 (1.00)", "-"], "reached": ["-", "1 (0.25)"], "object lost": ["-", "1"],
        NOT_GRASPED: ["-", "1"], "all": ["3 (1.00)", "3 (0.25)"],
    }  # fmt: skip


def test_means_over_the_motions_are_of_the_right_list() -> None:
    trials = frame([turn(), turn(prediction_ekm_deg=())])
    assert trials["prediction_km"].tolist() == [0.5, 0.5]
    assert trials["prediction_ekm"][0] == pytest.approx(0.2)
    assert trials["true_prediction_ekm"][0] == pytest.approx(0.1)
    assert np.isnan(trials["prediction_ekm"][1])
    assert trials["motions"].tolist() == [3, 3]


# -- intervals and tests -----------------------------------------------------------------------------


def test_bootstrap_is_scipys() -> None:
    values = np.random.default_rng(4).exponential(1.0, 20)
    theirs = scipy.stats.bootstrap(
        (values,), np.mean, n_resamples=4000, method="percentile", rng=np.random.default_rng(0)
    )
    ours = bootstrap_mean(values)
    np.testing.assert_allclose([ours.low, ours.high], theirs.confidence_interval, rtol=1e-12)
    one = bootstrap_mean(np.array([2.0]))
    assert (one.mean, one.low, one.high) == (2.0, 2.0, 2.0)
    paired = bootstrap_ratio(0.4 * values, values)  # pairs stay together: nothing is left to chance
    assert paired.high - paired.low < 1e-9


def test_rates_have_wilsons_interval() -> None:
    assert rate([True] + [False] * 19) == "1/20 [1, 24] %"  # Wilson (1927): 0.00888, 0.23613


@pytest.mark.filterwarnings("error")
def test_tests_are_scipys_and_warn_of_nothing() -> None:
    """Welch's test and the interval; constants, for which scipy warns, are told."""
    rng = np.random.default_rng(3)
    ours, theirs = rng.normal(1.0, 0.5, 12), rng.normal(1.3, 0.2, 12)
    curve = learning_curve(ours, theirs)
    one = scipy.stats.ttest_ind(ours, theirs, equal_var=False, alternative="less")
    assert curve.p[-1] == pytest.approx(one.pvalue)
    assert curve.upper[-1] == pytest.approx(one.confidence_interval(0.95).high)
    lost = np.full(12, 20.0)
    constant = learning_curve(lost - 1.0, lost)
    assert constant.p[1:].tolist() == [0.0] * 11
    assert constant.last_upper == -1.0


def test_learning_curve_marks_the_last_negative_result() -> None:
    rng = np.random.default_rng(2)
    theirs = 2 + 0.3 * rng.normal(size=45)
    ours = theirs.copy()
    ours[8:] = 0.5 + 0.1 * rng.normal(size=37)  # learned after eight trials
    curve = learning_curve(ours, theirs)
    assert 8 <= curve.last_negative <= 12
    assert curve.last_upper < -0.5
    assert np.isnan(curve.p[0])
    never = learning_curve(theirs + 0.5, theirs)
    assert never.last_negative == 45
    assert never.last_upper > 0


def test_recovery_counts_from_the_trial_after_the_event() -> None:
    km = pandas.DataFrame(1.0, [0, 1], range(1, 9))
    ekm = pandas.DataFrame([[0.2, 0.2, 2.0, 0.8, 0.4, 0.2, 0.2, 0.2], [1.0] * 8], [0, 1], range(1, 9))
    found = learning(ekm, km, (1, 3, 8))
    assert found.loc[0, ["after_1", "after_3"]].tolist() == [1, 2]
    assert found.loc[1, ["after_1", "after_3"]].isna().all()
    assert found["after_8"].isna().all()


# -- tables ------------------------------------------------------------------------------------------


def test_tables_hold_numbers_and_write_them_in_the_format_of_their_column() -> None:
    share = Column("share [%]", ".0f", percent=True)
    cells = [
        [0.123, 0.456],
        [Estimate(0.5, 0.25, 0.75, 9), Estimate(0.5, 0.25, 0.75, 9)],
        [3, 3],
        [True, None],
    ]
    table = Table("name", "caption", ["plain", share], cells)
    assert table.rows[0][0] == 0.123
    assert table.header == ["plain", "share [%]"]
    assert table.text() == [
        ["0.12", "46"], ["0.50 [0.25, 0.75]", "50 [25, 75]"], ["3", "3"], ["yes", "-"],
    ]  # fmt: skip
    assert Column("p", ".1g").text(0.00123) == "0.001"
    assert str(Estimate(0.12345, 0.1, 0.2, 3)) == "0.123 [0.1, 0.2]"
    assert Column("nothing").text(float("nan")) == "-"


def test_tables_show_means_ratios_and_losses() -> None:
    records = [turn("KM", seed, 2.0 + seed) for seed in range(4)]
    records += [turn("E-KM", seed, 0.5 + 0.25 * seed) for seed in range(4)]
    records[0] = turn("KM", 0, 2.0, reason="object lost")
    trials = frame(records)
    table = error_table(trials, "object")
    row = dict(zip(table.header, table.rows[0], strict=True))
    assert re.fullmatch(r"8\.00 \[.*\]; 1, 0", row["KM"])  # (20 + 3 + 4 + 5) / 4
    assert re.fullmatch(r"0\.88 \[.*\]; 0, 0", row["E-KM"])
    assert ratio(trials, "KM").mean == pytest.approx(0.875 / 8)
    assert [row[0] for row in table.rows] == ["box", "all"]
    controllers = controller_table(trials)
    shown = dict(zip(controllers.header, controllers.rows[0], strict=True))
    assert shown["controller"] == "KM"
    assert shown["motions"].mean == pytest.approx(3.0)
    predicted = dict(zip(controllers.header, controllers.rows[1], strict=True))
    assert predicted["KM, one motion [deg]"].mean == pytest.approx(0.5)
    assert predicted["E-KM, one motion [deg]"].mean == pytest.approx(0.2)


def test_the_answer_comes_in_a_sentence_with_losses_and_no_verdict_from_few_seeds() -> None:
    def records(n: int) -> list[TrialRecord]:
        found = []
        for seed in range(1000, 1000 + n):
            found += [turn("KM+S", seed, 0.3), turn("KM", seed, 2.0 + 0.01 * seed)]
            found.append(turn("E-KM", seed, 0.2, reason="object lost" if seed == 1000 else "reached"))
        return found

    few, many = (verdict(frame(records(n)), range(1000, 1000 + n)) for n in (4, 12))
    assert few.startswith("The E-KM ends 5.15 [0.20, ")
    assert "from the target, KM+S 0.30 [0.30, 0.30] deg, KM " in few
    assert (
        "on 4 seeds. Objects lost, and turns that did not reach the target: E-KM 1 and 0 of 4, KM+S 0 and "
        in few
    )
    assert "Fewer than 10 seeds: differences are not tested." in few
    assert "paired" not in few
    assert "Error of the E-KM over that of KM+S " in many
    assert "not tested" not in many


def test_where_most_turns_fail_the_answer_says_why() -> None:
    ends = {"reason": "object lost", "message": "turned off the axis"}
    said = verdict(frame([turn("E-KM", 0, 0.1), *(turn("E-KM", k, 9.0, **ends) for k in (1, 2))]), range(3))
    assert "The E-KM: 2 of 3 turns ended with 'object lost': turned off the axis." in said
    assert "ended with" not in verdict(frame([turn("E-KM", k, 0.1) for k in range(3)]), range(3))


def test_learning_finds_the_last_negative_result() -> None:
    generator = np.random.default_rng(0)
    records = []
    for trial in range(1, 25):
        ekm = 1.0 if trial <= 3 else 0.3
        noise = generator.normal(0, 0.05, size=2)
        km, ekm = (1.0 + noise[0],), (ekm + noise[1],)
        records.append(turn("E-KM", 0, trial=trial, prediction_km_deg=km, prediction_ekm_deg=ekm))
    online = Online(trials=24, dislocations=(10, 24), tendons_replaced=0)
    row = learning(*prediction_curves(frame(records), 24), online.events).loc[0]
    assert 3 <= row.last_negative <= 7
    assert 0.25 <= row.late <= 0.36  # trials 17 to 24 without 24
    assert row.after_10 == 1
    assert np.isnan(row.after_24)  # after the last trial there is nothing to see
    found = {of[0]: of[2:] for of in online.paper_table(frame(records)).text()}
    assert found["trials until recovered after trial 10"] == ["1.00", "1"]
    ekm, _ = prediction_curves(frame(records[:5]), 6)
    assert ekm.loc[0].notna().tolist() == [True] * 5 + [False]


def test_cells_are_won_and_lost_hand_by_hand() -> None:
    records = []
    for seed, item, trial in itertools.product(range(12), ("box", "can"), range(3)):
        where = {"object": item, "trial": trial, "angle_deg": 5.0 * (trial + 1)}
        theirs = 1.0 + 0.1 * trial
        ours = 2.0 if (item, trial) == ("can", 1) and seed < 3 else 0.1 * theirs
        records += [turn("KM", seed, theirs, **where), turn("E-KM", seed, ours, **where)]
    trials = frame(records)
    found = {row[0]: row[1:] for row in significance_table(trials).text()}
    assert found["cells won"] == ["24 of 25", "6 of 6, least 5"]
    assert found["cells lost (hands)"][1] == "can, trial 2 (3)"
    assert float(found["p of two samples, one hand (median)"][1]) < 1e-4
    assert not significance_table(trials[trials["controller"] == "KM"]).rows
