"""The matrix of trials: hands, contenders, what is counted, and that every question runs and resumes."""

import dataclasses
import itertools
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[1] / "experiments"))

import matrix
from contenders import BEGINNINGS, PARTS, PLANS, PRINTED, READINGS, WHOLE_TURNS, MisprintedBench
from hands import CONDITIONS, FAMILIES, OTHERS, STRENGTHS, hands
from made_up_sessions import frame
from matrix import FIGURES, bands_table, ends_table, verdict
from questions import QUESTIONS
from sessions import TARGETS, Part, target_of

from torch_ekm.experiments import runner
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import NOT_GRASPED, TrialRecord
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import preset

BANDS = ([1, 0.5, 0.2, [0.1, -2.0]], [6, -1.7, 0.1, []])


def row(
    reason: str, turning: int, off: float = 1.0, ekm: tuple[float, ...] = (), contender="E-KM", **figures
) -> TrialRecord:
    return TrialRecord(
        "box", "turn", "E-KM", 0, 1, 27.0, reason, "", 0.1, (27.0, 0.1), 0.1, (), (), (0.5,) * len(ekm),
        ekm, off, (0.01,) * (turning + 1), turning=turning, simulated_s=0.5 * turning,
        more={"plant": "odd 4", "contender": contender, **figures},
    )  # fmt: skip


def test_every_family_has_three_strengths_that_differ_from_the_nominal_hand() -> None:
    def changes(hand) -> set[str]:
        nominal, plant = preset("nominal"), hand["plant"]
        return {
            f.name for f in dataclasses.fields(plant) if getattr(plant, f.name) != getattr(nominal, f.name)
        }

    found = hands(["all"])
    assert len(found) == 3 * len(FAMILIES) + len(OTHERS)
    for family in FAMILIES:
        changed = [changes(found[f"{family}:{strength}"]) for strength in STRENGTHS]
        assert changed[0] == changed[1] == changed[2] != set()
        assert "hardware_seed" not in changed[0]
    assert set(hands(["strong"])) == {f"{f}:strong" for f in FAMILIES} | set(OTHERS)
    assert hands(["conditions"])["friction 0.4, mass 3"]["plant"].friction == 0.4
    settings = [
        str(Setting().replace(**hand).figures()) + str(hand.get("hand")) for hand in CONDITIONS.values()
    ]
    assert len(set(settings)) == len(CONDITIONS)
    with pytest.raises(SystemExit, match="'arm' is no hand"):
        hands(["arm"])


@pytest.mark.parametrize("group", [WHOLE_TURNS, PLANS, PARTS, PRINTED, BEGINNINGS, READINGS])
def test_contenders_differ_in_what_they_are_called(group) -> None:
    made = [(one.controller, one.bench, one.setting(Setting())) for one in group.values()]
    assert len({str(one) for one in made}) == len(group)


def test_lost_reached_movements_and_bands_are_counted() -> None:
    ours = [
        row("reached", 1, bands=BANDS, ekm=(0.4, 0.2)),
        row("reached", 2, off=3.0, bands=[], ekm=(0.1,) * 4),
        row("given up", 9, bands=[]),
        row("object lost", 9, bands=[]),
        row("reached", 3, off=31.0, bands=[]),  # turned off the axis beyond help
    ]
    turns = frame([*ours, row("reached", 8, contender="without plan", bands=[])])
    told = (
        "E-KM lost 2 of 5, reached 2, turning movements 1.5, all motions 2.5, seconds 0.8; "
        "without plan lost 0 of 1, reached 1, turning movements 8.0, all motions 9.0, seconds 4.0"
    )
    assert verdict(turns, "contender") == told
    mine = turns[turns["contender"] == "E-KM"]
    assert FIGURES["error [deg]"].of(mine) == pytest.approx((0.3 - 0.1 + 27 + 27 + 0.1) / 5)
    assert FIGURES["off the axis, largest [deg]"].of(mine) == 3.0
    assert FIGURES["other ends"].of(mine) == "1 given up, 1 object lost, 1 reached"
    # the first five motions with the object, over its turns
    assert FIGURES["E-KM, first 5 [deg]"].of(mine) == pytest.approx((0.4 + 0.2 + 0.1 * 3) / 5)
    assert FIGURES["KM, first 5 [deg]"].of(mine) == pytest.approx(0.5)
    cells = ["6", "2, 2, 2.5", "0, 1, 9.0"]
    assert ends_table(turns, "contender", "plant").text() == [["odd 4", *cells], ["all", *cells]]
    (bands,) = bands_table(turns).text()
    assert bands == ["E-KM", "2", "50 % of 2", "100 % of 2", "50 % of 2"]


def test_an_end_without_a_grasp_is_no_turn() -> None:
    lost = TrialRecord("box", "turn", "KM", 0, 1, 9.0, NOT_GRASPED, "too wide")
    assert len(QUESTIONS["hands"].counted(frame([lost, row("reached", 1)]))) == 1


def test_targets_have_one_to_six_directions_each_named_once() -> None:
    sizes = set()
    for parts in itertools.chain.from_iterable(TARGETS.values()):
        assert len({(part.unit, part.axis) for part in parts}) == len(parts)
        assert any(part.size for part in parts)
        sizes.add(len(parts))
    assert sizes == {1, 2, 5, 6}
    axes = dict(zip("abc", torch.eye(3, dtype=torch.float64), strict=True))
    start = GraspState(torch.zeros(4), torch.ones(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    error = target_of(start, (Part("deg", "a", 8.0), Part("mm", "b", -3.0)), axes).error(start)
    assert torch.rad2deg(error[3:]).tolist() == pytest.approx([8.0, 0.0, 0.0])
    assert error[:3].tolist() == pytest.approx([0.0, -3e-3, 0.0])


def test_the_misprinted_stiffness_is_the_papers_letter_by_letter() -> None:
    """``D_oq dq = sum_i (J_i dq) x f_i``, the printed sign of T; the object's own columns are empty."""
    one = PRINTED["KM, J_m as misprinted"]
    bench = MisprintedBench(one.setting(Setting(engine="mujoco")), "box", "KM")
    state = bench.grasp(3, 0)
    kin = bench.model.contact_kinematics(state, bench.model.contacts(state))
    random = torch.Generator().manual_seed(0)
    force = torch.randn(len(kin.point_jacobian), 3, generator=random, dtype=torch.float64)
    D, n_q = bench.model.load_stiffness(kin, force, torch.zeros(len(force))), bench.model.hand.n_q
    dq = torch.randn(n_q, generator=random, dtype=torch.float64)
    moment = torch.linalg.cross(kin.point_jacobian @ dq, force).sum(0)
    torch.testing.assert_close(D[n_q + 3 :, :n_q] @ dq, moment)
    assert not bool(D[:, n_q:].any())
    ours = KinematicModel(bench.hand.hand, bench.hand.object)
    right = ours.load_stiffness(kin, force, torch.zeros(len(force)))
    assert not torch.allclose(right, D)
    bench.close()


def test_a_question_runs_and_what_is_done_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["whole_turn", "--quick", "--jobs", "1", "--out", str(tmp_path)]
    matrix.main(words)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("E-KM lost 0 of 1, reached 1, turning movements ")
    assert "; without plan lost 0 of 1" in last
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/nominal_box_*.json")}
    assert len(kept) == 2
    matrix.main(words)
    assert capsys.readouterr().out.splitlines()[-1] == last
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    assert (tmp_path / "trials.csv").exists()
    assert (tmp_path / "whole_turn.svg").exists()
    with pytest.raises(SystemExit):
        matrix.main(["whole_turn", "--contenders", "PID"])


@pytest.mark.parametrize("name", ["generalize", "series", "directions", "printed", "new_object", "slides"])
def test_every_kind_of_session_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_MOTIONS", 3)
    monkeypatch.setitem(TARGETS, "shift 3 mm", TARGETS["shift 3 mm"][:2])
    asked = QUESTIONS[name]
    made = matrix.ask(asked, ["--quick", "--engine", "mujoco", "--jobs", "1", "--out", str(tmp_path)])
    assert all(len(table.rows) for table in made.tables)
    assert not asked.columns or made.tables[0].header[1:] == list(asked.columns)


def test_a_new_object_begins_with_the_hand_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_MOTIONS", 5)
    grasps = []

    class Noted(Bench):
        def trial(self, *what, **options):
            grasps.append((self.name, int(self.knowledge.figures.count), self.learner))
            return super().trial(*what, **options)

    setting = Setting(hand="planar_two_finger", engine="mujoco").hardware_instance(3)
    made = runner.new_objects(lambda item: Noted(setting, item, "E-KM"), ["box", "can"], 3, angles=(4.0,))
    assert (made[-1].object, made[-1].kind) == ("can", "turn")
    assert {(one.object, one.kind) for one in made[:-1]} == {("box", "first")}
    (_, none, _), *_, (item, known, learner) = grasps
    assert none == 0
    assert (item, learner) == ("can", None)  # the object's own learner is empty
    assert known >= 5


def test_foresight_says_what_was_predicted_and_what_came(tmp_path: Path) -> None:
    words = ["--quick", "--engine", "mujoco", "--jobs", "1", "--contenders", "E-KM", "--out", str(tmp_path)]
    made = matrix.ask(QUESTIONS["foresight"], words)
    parts = {text[0]: text for text in made.tables[0].text()}
    assert float(parts["E-KM"][4]) == pytest.approx(6.0, abs=1.5)


def test_tables_fit_on_a_page() -> None:
    """At most eight columns, and eight rows of contenders."""
    for name, asked in QUESTIONS.items():
        assert len(asked.columns) <= 7, name
        assert not set(asked.columns) - set(FIGURES), name
        assert len(asked.contenders) <= 8, name
