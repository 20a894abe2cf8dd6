"""What was learned of a hand goes from loop to loop and from session to session."""

import json
import math

import pytest
import torch
from obedient_plant import Obedient, untaught
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.control import ClosedLoop, DescribedFigures, HandKnowledge, LookAndMoveController, PoseTarget
from torch_ekm.enhanced import ParameterFilter, save
from torch_ekm.estimation.filters import ForceSensitivity
from torch_ekm.estimation.knowledge import ModelError, previous
from torch_ekm.exceptions import FileFormatError, ParameterError, StateError, StateMismatchError
from torch_ekm.kinematics import ServoModel
from torch_ekm.kinematics.servo_model import IdealServos
from torch_ekm.residual import SparseOnlineGP

DEG = math.pi / 180


@pytest.fixture(scope="module")
def driven(held) -> ClosedLoop:
    (seen, axis, _), loop = held, untaught(held)
    loop.run(PoseTarget.turned(seen.state, axis, degrees=15))
    return loop


def test_a_file_gives_back_the_same_to_the_bit(driven, tmp_path) -> None:
    driven.knowledge.save(tmp_path / "hand.ekm")
    again = HandKnowledge.load(tmp_path / "hand.ekm")
    before, after = driven.knowledge.state_dict(), again.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert float(again.servo.standard_errors[0].min()) < 0.3 * DEG  # 1.0 before anything was learned


def test_the_next_loop_goes_on_with_it(held, driven) -> None:
    seen, axis, model = held
    loop = ClosedLoop(Obedient(model, seen), LookAndMoveController(model, axis), knowledge=driven.knowledge)
    before = driven.knowledge.servo.weight.clone()
    loop.run(PoseTarget.turned(seen.state, axis, degrees=5))
    assert loop.knowledge is driven.knowledge
    assert bool((driven.knowledge.servo.weight != before).any())


def test_a_plain_model_learns_nothing_of_the_servos(held) -> None:
    seen, axis, model = held
    plant = Obedient(model, seen)
    loop = ClosedLoop(plant, LookAndMoveController(model, axis))
    steps = loop.run(PoseTarget.turned(seen.state, axis, degrees=5)).steps
    assert isinstance(loop.knowledge.servo, IdealServos)
    for step, given in zip(steps, plant.given, strict=True):  # commands are those that were decided
        torch.testing.assert_close(step.decision.delta_a, given, rtol=0, atol=1e-12)


def test_knowledge_of_another_hand_and_another_file_are_refused(held, driven, tmp_path) -> None:
    seen, axis, model = held
    with pytest.raises(StateError, match="a hand with the actuators"):
        ClosedLoop(
            Obedient(model, seen),
            LookAndMoveController(model, axis),
            knowledge=HandKnowledge(ServoModel(["one", "two"]), ForceSensitivity(5, 2), DescribedFigures()),
        )
    other = HandKnowledge(
        ServoModel(model.hand.actuator_names), ForceSensitivity(2, model.hand.n_a), DescribedFigures()
    )
    with pytest.raises(StateError, match="the hand has 5 pads and 9 actuators"):
        other.check(model.hand)
    save(SparseOnlineGP(2, 1), tmp_path / "learner.ekm")
    with pytest.raises(FileFormatError, match="holds a SparseOnlineGP, no HandKnowledge"):
        HandKnowledge.load(tmp_path / "learner.ekm")
    with pytest.raises(FileFormatError):
        HandKnowledge.load(tmp_path / ("n" * 300))  # a name that no file can have


IMPOSSIBLE = {  # entry, an index, and a value that no estimator comes to
    "bias": ("servo.estimate", (0, 1), 0.2),
    "dead zone": ("servo.estimate", (3, 0), 0.2),
    "dead zone before": ("servo.before", (3, 0), -0.2),
    "no covariance": ("servo.covariance", ..., 0.0),
    "a negative one": ("servo.covariance", (1, 0, 0), -1.0),
    "not symmetric": ("servo.covariance", (1, 0, 1), 1.0),
    "less than nothing": ("servo.before_covariance", (1, 0, 0), 1e3),
    "weight": ("servo.weight", 2, 0.0),
    "more than all": ("servo.weight", 2, 300.0),
    "noise": ("servo.squares", 0, -1.0),
    "no noise": ("servo.squares", 0, 0.0),
    "stuck": ("servo.stuck", ..., True),
    "failures": ("servo.failures", 0, -1),
    "surprises": ("servo.surprises", 0, 2),
    "forces": ("forces.theta", (0, 3), 6.0),
    "forces of nothing": ("forces.theta", (4, 0), -2.0),
    "spread of forces": ("forces.variance", 1, 1e6),
    "no spread of forces": ("forces.variance", 1, 0.0),
    "evidence": ("forces.evidence", (0, 1, 1), -1.0),
    "endless evidence": ("forces.evidence", (0, 1, 1), 1e300),
    "figures": ("figures.mean", 0, 5.1),
    "no figure": ("figures.mean", 0, math.nan),
    "endless figure": ("figures.mean", 0, math.inf),
    "covariance of figures": ("figures.covariance", (0, 0), 1e3),
    "usual": ("figures.usual", (), 1e30),
    "error": ("error.square", 0, 1.1),
    "error below 0": ("error.square", 1, -0.1),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_figures_that_no_hand_can_have_are_refused_by_name(driven, tmp_path, what) -> None:
    name, at, value = IMPOSSIBLE[what]
    knowledge = HandKnowledge.of(driven.controller.kinematic.hand)
    knowledge.load_state_dict(driven.knowledge.state_dict())
    dict(knowledge.named_buffers())[name][at] = value
    knowledge.save(tmp_path / "hand.ekm")
    with pytest.raises(FileFormatError, match=name.replace(".", r"\.")):
        HandKnowledge.load(tmp_path / "hand.ekm")


def test_figures_that_no_motion_taught_are_refused(driven) -> None:
    knowledge = HandKnowledge.of(driven.controller.kinematic.hand)
    state = {name: value.clone() for name, value in knowledge.state_dict().items()}
    with pytest.raises(StateMismatchError, match="no motion was learned"):
        knowledge.load_state_dict({**state, "figures.mean": state["figures.mean"] + 1.0})
    with pytest.raises(StateMismatchError, match="without evidence"):
        knowledge.load_state_dict({**state, "forces.theta": state["forces.theta"] + 1.0})
    assert all(torch.equal(state[name], value) for name, value in knowledge.state_dict().items())


def test_whatever_is_learned_can_be_loaded(generator) -> None:
    """Readings of all kinds, glitches of a radian among them, lead to states within the bounds."""

    def draw(*shape: int) -> torch.Tensor:
        size = 10 ** (6 * torch.rand((), generator=generator) - 4)
        return size * torch.randn(*shape, generator=generator).double()

    servo, forces, n = ServoModel("abcd"), ForceSensitivity(3, 4), 6
    figures = ParameterFilter("abcdef", [0.0] * n, [0.5] * n, [-1.0] * n, [1.0] * n)
    still = torch.rand(300, 4, generator=generator) < 0.4
    for motion in range(300):
        servo.update(draw(4), draw(4) * ~still[motion])
        forces.update(draw(4), draw(3), draw(3), 0.1)
        figures.update(draw(5), draw(5, n), draw(5).square() + 1e-6)
        for part in (servo, forces, figures):
            assert part.state_problems(part.state_dict()) == []
    S, w = torch.full((1, 1), 5.0).double(), torch.full((1,), 0.1).double()
    pad = ForceSensitivity(1, 1)
    for _ in range(200):  # one that answers fifty times as much as it is described to
        pad.update(w, 50 * S @ w, S @ w, 0.0)
    assert 4 < float(pad.theta.abs().max()) <= 5
    assert pad.state_problems(pad.state_dict()) == []
    ideal = ServoModel("a")
    for _ in range(3000):  # encoders that never err
        ideal.update(torch.full((1,), 0.01), torch.full((1,), 0.01))
    assert ideal.state_problems(ideal.state_dict()) == []


def test_the_last_good_file_is_kept_and_named(driven, tmp_path) -> None:
    path, knowledge = tmp_path / "hand.ekm", HandKnowledge.of(driven.controller.kinematic.hand)
    driven.knowledge.save(path)
    assert not previous(path).exists()
    good = path.read_bytes()
    knowledge.save(path)
    assert previous(path).read_bytes() == good
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(
        FileFormatError, match=r"cut short; the last file that was good is .*hand\.ekm\.previous"
    ):
        HandKnowledge.load(path)
    knowledge.save(path)  # in place of a damaged file, which is not kept
    assert previous(path).read_bytes() == good


def test_parts_are_reset_alone(driven) -> None:
    hand = driven.controller.kinematic.hand
    fresh = HandKnowledge.of(hand).state_dict()
    for part in ("servo", "forces", "figures", "error"):
        knowledge = HandKnowledge.of(hand)
        knowledge.load_state_dict(driven.knowledge.state_dict())
        knowledge.reset(part)
        for name, value in knowledge.state_dict().items():
            expected = fresh if name.startswith(part) else driven.knowledge.state_dict()
            assert torch.equal(value, expected[name]), name
    with pytest.raises(ParameterError, match="one of servo, forces, figures, error"):
        knowledge.reset("fingers")


def test_what_is_believed_is_shown(driven, tmp_path) -> None:
    path = tmp_path / "hand.ekm"
    driven.knowledge.save(path)
    shown = CliRunner().invoke(app, ["knowledge", str(path)])
    assert shown.exit_code == 0, shown.output
    assert "motions:" in shown.output
    assert "that of 'icub_right'" in shown.output
    other = CliRunner().invoke(app, ["knowledge", str(path), "--hand", "planar_two_finger", "--json"])
    told = json.loads(other.output)
    assert "a hand with the actuators" in told["description"]
    assert told["motions"] == int(driven.knowledge.figures.count)
    found = {(one["name"], one["figure"]): one for one in told["estimates"]}
    assert found["thumb_distal", "dead zone [deg]"]["value"] == pytest.approx(
        float(driven.knowledge.servo.dead_zone[3]) / DEG
    )
    assert len(told["estimates"]) == 2 * 9 + 5 + len(driven.knowledge.figures) + 2
    assert CliRunner().invoke(app, ["knowledge", str(path), "--reset", "servo"]).exit_code == 0
    assert not bool(HandKnowledge.load(path).servo.estimate.any())
    assert bool(HandKnowledge.load(previous(path)).servo.estimate.any())


def test_a_hand_that_dropped_an_object_grips_the_next_one_tighter() -> None:
    error = ModelError()
    error.slid(lost=True)
    assert float(error.tighter) == 1.5
    error.begin()
    assert float(error.tighter) == pytest.approx(1.05)
    for _ in range(9):
        error.slid()
    assert float(error.tighter) == 3.0
