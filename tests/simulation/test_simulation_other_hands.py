"""Hands of other kinds in both engines: what is planned is what the simulated hand does."""

import functools
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import write_hand
from other_hands import main

from torch_ekm.description import HandDescription, load_hand, write_template
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.model.kinematic_model import softened
from torch_ekm.simulation import PlantConfig, SimulatedHand

KINDS = {"tendon_springs": 0.05, "not_round": 0.05, "four_bar": 0.25, "idle": 0.05, "coupled": 0.15}
"""And how much of the planned force may be missing: loops give way a little."""


@functools.cache  # both engines hold it by one plan
def made(kind: str) -> HandDescription:
    with tempfile.TemporaryDirectory() as folder:
        return load_hand(write_hand(kind, Path(folder)))


@pytest.mark.parametrize(
    ("kind", "engine"),
    [*((kind, "sapien") for kind in ("tendon_springs", "four_bar", "idle")),
     *((kind, "mujoco") for kind in ("not_round", "four_bar", "coupled"))],
)  # fmt: skip
def test_a_planned_pinch_holds_as_planned(kind: str, engine: str) -> None:
    plant = SimulatedHand(made(kind), "can", engine=engine)
    seen = plant.reset(0)
    hand, truth = plant.hand, seen.truth
    planned = np.linalg.norm(plant.plan.forces, axis=1)
    used = [pad.name in plant.plan.pads for pad in hand.pads]
    np.testing.assert_allclose(truth.fingertip_force[used], planned, rtol=KINDS[kind])
    np.testing.assert_allclose(truth.q, plant.plan.q, atol=0.05)
    assert (seen.a.numpy() >= hand.actuator_lower - 1e-9).all()
    np.testing.assert_allclose(hand.coupling @ truth.q.numpy(), 0.0, atol=0.01)
    if hand.loops is not None:
        arms = np.linalg.norm(hand.loops.lengths.typical, axis=1)
        assert np.abs(hand.loops.gap(truth.q.numpy()) / arms).max() < 0.02
    moved = plant.command(torch.full((hand.n_a,), 0.02, dtype=torch.float64)).truth
    assert float((moved.fingertip_force - truth.fingertip_force).abs().max()) > 0.05
    plant.close()


def test_a_grasp_that_its_force_makes_soft_is_planned_with_less(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = SimulatedHand("icub_right", "can", engine="mujoco")
    seen = plant.reset(0)
    assert np.linalg.norm(plant.plan.forces[0]) == pytest.approx(5.0, rel=0.02)
    model = KinematicModel(plant.hand, plant.object, ModelOptions(on_unstable="flag"))
    lin = model.linearize(seen.state, fingertip_force=seen.fingertip_force)
    names = "mu", "force", "normal", "spin_moment"
    tenfold = replace(lin.forces, **{name: 10 * getattr(lin.forces, name) for name in names})
    assert not softened(model, lin)
    assert softened(model, model.linearize(seen.state, lin.contacts, forces=tenfold))
    monkeypatch.setattr("torch_ekm.simulation.simulated_hand.softened", lambda model, lin: True)
    plant.reset(0)
    assert np.linalg.norm(plant.plan.forces[0]) == pytest.approx(3.0, rel=0.02)
    asked = SimulatedHand("icub_right", "can", PlantConfig(pinch_force=5.0), engine="mujoco")
    asked.reset(0)
    assert np.linalg.norm(asked.plan.forces[0]) == pytest.approx(5.0, rel=0.02)


def test_the_benchmark_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_hand("metres", tmp_path)
    (tmp_path / "broken.urdf").write_text("<robot/>")
    main([str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[-1] == "hands 2, read 1, pinched 1, turned 1, lost 0"


def test_a_template_puts_pads_on_the_tips_and_sees_that_the_hand_is_not_planar(tmp_path: Path) -> None:
    urdf = write_hand("servos", tmp_path)
    urdf.with_suffix(".transmission.toml").unlink()
    text = write_template(urdf).read_text()
    assert re.findall(r'\nlink = "(\w+)"', text) == [
        f"{name}_link_3" for name in ("thumb", "index", "middle", "ring")
    ]
    assert text.count("start = [0, 0, 0.025]") == 4
    assert "planar_normal" not in text
