"""Hands of other kinds in both engines: what is planned is what the simulated hand does."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_hands import write_hand
from other_hands import main

from torch_ekm.description import load_hand, load_object, write_template
from torch_ekm.model import KinematicModel, ModelOptions
from torch_ekm.model.softening import softened
from torch_ekm.simulation import PlantConfig, SimulatedHand

KINDS = {"tendon_springs": 0.05, "not_round": 0.05, "four_bar": 0.25, "idle": 0.05, "coupled": 0.15}
"""And how much of the planned force may be missing: loops give way a little."""


@pytest.mark.parametrize(
    ("kind", "engine"),
    [*((kind, "sapien") for kind in ("tendon_springs", "four_bar", "idle")),
     *((kind, "mujoco") for kind in ("not_round", "four_bar", "coupled"))],
)  # fmt: skip
def test_a_planned_pinch_holds_as_planned(kind: str, engine: str, tmp_path: Path) -> None:
    plant = SimulatedHand(load_hand(write_hand(kind, tmp_path)), "can", engine=engine)
    seen = plant.reset(0)
    hand, truth = plant.hand, seen.truth
    assert truth is not None
    assert truth.fingertip_force is not None
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
    assert moved is not None
    assert moved.fingertip_force is not None
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


_REACH = {"near": 0.045, "far": 0.03}  # [m] from joint to joint, and to the middle of the tip
_FINGERS = {"a": (-0.035, 0.0, 1), "b": (0.035, 0.022, -1), "c": (0.035, -0.022, -1)}  # x, y [m]; sense
_FIGURES = {  # in the template's order of words
    r'spring = "TODO"': "spring = 0.12",
    r'range_deg = \["TODO", "TODO"\]': "range_deg = [-20, 140]",
    r'= "TODO"': "= 1.0",
    r"# stiffness = 4.0": "stiffness = 8.0",
}


def _solid(radius: float, first: float, last: float) -> str:
    def part(shape: str, z: float) -> str:
        return f'<collision><origin xyz="0 0 {z}"/><geometry><{shape}/></geometry></collision>'

    ball = f'sphere radius="{radius}"'
    tube = part(f'cylinder radius="{radius}" length="{last - first}"', (first + last) / 2)
    return tube + part(ball, first) + part(ball, last)


def _link(name: str, mass: float, solid: str) -> str:
    inertia = '<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial>{solid}</link>'


def _joint(kind: str, parent: str, child: str, at: str, rest: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
    return f'<joint name="{child}_joint" type="{kind}">{ends}{rest}</joint>'


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    parts = [_link("palm", 0.3, "")]
    for name, (x, y, sense) in _FINGERS.items():
        near, far, tip = f"{name}_near", f"{name}_far", f"{name}_tip"
        rest = f'<axis xyz="0 {sense} 0"/><limit lower="-0.8" upper="1.5" effort="5" velocity="5"/>'
        parts += [
            _link(near, 0.03, _solid(0.007, 0.0, _REACH["near"])),
            _link(far, 0.02, _solid(0.007, 0.0, 0.02)),
            _link(tip, 0.005, _solid(0.008, -0.006, 0.006)),
            _joint("revolute", "palm", near, f"{x} {y} 0.0125", rest),
            _joint("revolute", near, far, f"0 0 {_REACH['near']}", rest),
            _joint("fixed", far, tip, f"0 0 {_REACH['far']}"),
        ]
    urdf = tmp_path_factory.mktemp("hand") / "three.urdf"
    urdf.write_text(f'<robot name="three">{"".join(parts)}</robot>')
    return urdf, write_template(urdf)


def test_the_template_puts_pads_on_the_tips_and_sees_that_the_hand_is_not_planar(files):
    text = files[1].read_text()
    assert re.findall(r'\nlink = "(\w+)"', text) == ["a_tip", "b_tip", "c_tip"]
    assert text.count("start = [0, 0, -0.006]") == 3
    assert "planar_normal" not in text


def test_all_pads_hold_and_are_felt(files):
    urdf, transmission = files
    text = transmission.read_text()
    for sense in (1, -1, -1):
        text = text.replace('["TODO", "TODO", "TODO"]', f"[{sense}, 0, 0]", 1)
    for old, new in _FIGURES.items():
        text = re.sub(old, new, text)
    transmission.write_text(text)
    plant = SimulatedHand(load_hand(str(urdf)), load_object("box"))
    seen = plant.reset(seed=0)
    assert plant.plan.pads == ("tip_1", "tip_2", "tip_3")
    thumb, *fingers = seen.fingertip_force.tolist()
    assert thumb == pytest.approx(plant.hand.pinch_force, abs=0.5)
    assert sum(fingers) == pytest.approx(thumb, abs=9.81 * plant.object.mass)  # its weight hangs on all
    assert min(fingers) > 1.0
