"""The paper's experiments, small: paired grasps, events, settings, learners by name."""

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from made_up_sessions import frame, not_grasped

from torch_ekm.control import DEFAULT_TASKS, EffortTask, OneStep, Safety, StepBound, StoppingRule
from torch_ekm.description.registry import object_paths
from torch_ekm.exceptions import ParameterError, UnknownNameError
from torch_ekm.experiments.config import CONTROLLERS, Setting, digest
from torch_ekm.experiments.learners import HAND_LEARNERS, make_learner
from torch_ekm.experiments.protocols.generalize import ENDS, OTHER_ANGLES, SHARES, TABLE_I, Generalize
from torch_ekm.experiments.protocols.online import Online
from torch_ekm.experiments.records import NOT_GRASPED, TrialRecord
from torch_ekm.experiments.runner import Bench

ONLINE = Online(trials=2, angle_range_deg=(4.0, 5.0), dislocations=(2,), tendons_replaced=2)


# -- without a simulation ----------------------------------------------------------------------------


def test_controllers_differ_in_the_reference_of_their_increments() -> None:
    setting = Setting()
    assert {c: setting.plant_config(c).relative_to for c in CONTROLLERS} == {
        "KM": "encoder", "KM+I": "setpoint", "KM+S": "encoder", "E-KM": "encoder",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "error", "match"),
    [
        ({"hand": "claw"}, UnknownNameError, "icub_left"),
        ({"learner": "oracle"}, UnknownNameError, "action-linear"),
        ({"preset": "mild"}, UnknownNameError, "nominal"),
        ({"capacity": 0}, ParameterError, "capacity"),
        ({"plant": {"spring": 2.0}}, ParameterError, "a PlantParameters"),
        ({"model": {"rolling": False}}, ParameterError, "a ModelOptions"),
        ({"limiting": StepBound()}, ParameterError, "a LimitingFunction"),
        ({"safety": StoppingRule()}, ParameterError, "a Safety"),
    ],
)
def test_wrong_settings_say_what_would_be_right(changes: dict, error: type, match: str) -> None:
    with pytest.raises(error, match=match):
        Setting(**changes)


def test_results_are_kept_under_all_that_decides_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def of(setting: Setting) -> str:
        return digest(setting, ("box",), Generalize(setting))

    base = Generalize()
    unchanged = of(Setting())
    assert of(Setting()) == unchanged
    assert of(Setting(tasks=(EffortTask(weight=0.02), *DEFAULT_TASKS[1:]))) != unchanged
    for figures in ({"planner": OneStep()}, {"bound": None}, {"safety": Safety(StoppingRule(max_steps=9))}):
        assert of(Setting(**figures)) == of(copy.deepcopy(Setting(**figures))) != unchanged
    with monkeypatch.context() as patch:  # a version whose learner has another kernel
        patch.setitem(HAND_LEARNERS, "action-linear", HAND_LEARNERS["rbf"])
        assert of(Setting()) != unchanged
    assert of(Setting()) == unchanged
    assert of(Setting(capacity=59)) != unchanged
    assert digest(Setting(), ("can",), base) != unchanged
    one, both = (dataclasses.replace(base, objects=o).jobs((0,)) for o in (("box",), ("box", "can")))
    assert set(one) < set(both)  # more objects: what is there is used again
    assert set(dataclasses.replace(base, objects=("box",), controllers=("KM",)).jobs((0,))) < set(one)
    assert len(both) == 2 * len(CONTROLLERS)


def test_a_corrected_object_does_not_take_up_old_results(tmp_path: Path) -> None:
    for source in object_paths("box"):
        (tmp_path / source.name).write_bytes(source.read_bytes())
    own = str(tmp_path / "box.urdf")

    def jobs() -> set[str]:
        return set(Generalize(objects=(own,)).jobs((0,)))

    before = jobs()
    assert before.isdisjoint(Generalize(objects=("box",)).jobs((0,)))  # other angles
    urdf = tmp_path / "box.urdf"
    urdf.write_text(urdf.read_text() + "\n")
    assert jobs().isdisjoint(before)
    assert len(jobs()) == len(before)


def test_every_object_is_asked_for_shares_of_its_end() -> None:
    protocol = Generalize()
    for item, end in ENDS.items():
        assert protocol.angles_of(item) == pytest.approx([share * end for share in SHARES], abs=0.05)
    for item, angles in TABLE_I.items():
        assert protocol.angles_of(item) == angles
    assert ENDS["carton"] < 10  # its links meet it: 25 deg were never to be reached
    assert protocol.angles_of("own.urdf") == OTHER_ANGLES
    assert dataclasses.replace(protocol, angles_deg=(3.0,)).angles_of("box") == (3.0,)


def test_every_learner_for_a_hand_starts_at_zero_and_learns() -> None:
    generator = torch.Generator().manual_seed(0)
    slope = torch.randn(4, 6, generator=generator, dtype=torch.float64)
    for name in HAND_LEARNERS:
        learner = make_learner(name, 5, 4, 30)
        x = torch.randn(120, 9, generator=generator, dtype=torch.float64)
        y = x[:, 5:] @ slope
        assert torch.equal(learner(x), torch.zeros(120, 6, dtype=torch.float64)), name
        learner.update(x, y)
        better = float((learner(x) - y).square().mean() / y.square().mean())
        assert better == 1.0 if name == "model alone" else better < 0.7, (name, better)
    with pytest.raises(UnknownNameError, match="rbf"):
        make_learner("forest", 5, 4, 30)


# -- with the simulation -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def online() -> dict[str, list[TrialRecord]]:
    sessions = {name: ONLINE.session(name, 0) for name in ("KM+I", "E-KM")}
    assert all(record.grasped for session in sessions.values() for record in session)
    return sessions


def test_every_controller_gets_the_same_grasps_and_targets(online: dict[str, list[TrialRecord]]) -> None:
    for ours, theirs in zip(online["E-KM"], online["KM+I"], strict=True):
        assert ours.angle_deg == theirs.angle_deg
        assert ours.errors_deg[0] == theirs.errors_deg[0]  # measured before the first motion


def test_learner_starts_empty_and_is_trained(online: dict[str, list[TrialRecord]]) -> None:
    first, second = online["E-KM"]
    assert first.prediction_ekm_deg[0] == pytest.approx(
        first.prediction_km_deg[0], abs=0.1
    )  # a bent path, in several pieces and in one
    assert second.prediction_ekm_deg[0] != pytest.approx(second.prediction_km_deg[0], rel=1e-3)
    assert online["KM+I"][0].prediction_ekm_deg == ()
    assert len(first.true_prediction_ekm_deg) == len(first.prediction_ekm_deg) == first.steps
    assert len(first.errors_deg) == first.steps + 1


def test_knock_is_felt_in_its_trial_only(online: dict[str, list[TrialRecord]]) -> None:
    calm, knocked = online["KM+I"]
    assert max(calm.true_prediction_km_deg) < 2.0
    third = knocked.true_prediction_km_deg[3]  # after the third motion
    assert third > 3 * calm.true_prediction_km_deg[3]


def test_same_seed_same_session() -> None:
    protocol = Generalize(
        Setting(hand="planar_two_finger", engine="mujoco"), objects=("can",), angles_deg=(4.0,), warm_up=1,
        poses=True,
    )  # fmt: skip
    runs = [protocol.session("can", "E-KM", 1) for _ in range(2)]
    for ours, theirs in zip(*runs, strict=True):
        assert dataclasses.replace(ours, seconds=()) == dataclasses.replace(theirs, seconds=())
    warm_up, turned = runs[0]
    assert (warm_up.kind, turned.kind) == ("warm-up", "turn")
    assert turned.true_error_deg < 1.0
    assert len(turned.poses) == turned.steps + 1
    assert warm_up.poses == ()  # for pictures of turns only


def test_what_cannot_be_grasped_is_recorded_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch_ekm.exceptions import GraspError

    bench = Bench(Setting(), "box", "KM")

    tried = []

    def fail(seed: int) -> None:
        tried.append(seed)
        raise GraspError("too wide")

    monkeypatch.setattr(bench.plant, "reset", fail)
    assert [bench.trial(0, 0, 5.0).reason for _ in range(2)] == [NOT_GRASPED] * 2
    often = len(tried)
    again = bench.trial(0, 1, 5.0)
    assert (again.reason, again.message, again.trial) == ("not grasped", "too wide", 1)
    assert len(tried) == often  # given up


def test_the_report_names_what_was_never_grasped(tmp_path: Path) -> None:
    trials = frame(not_grasped(who) for who in CONTROLLERS)
    report = Generalize(objects=("box",)).report((0,), trials, tmp_path)
    assert "box was never grasped (too wide)" in report.summary
    report.write(tmp_path)
    assert "never grasped" in (tmp_path / "index.html").read_text()
