"""Every script in examples/ runs from any folder, and prints what it is there to show."""

import functools
import math
import re
import runpy
import sys
from pathlib import Path

import pytest

from torch_ekm.control import ClosedLoop

EXAMPLES = Path(__file__).parents[2] / "examples"


def learner_takes_cost_off(said: str) -> bool:
    """And distance, of residual_mpc: by 30 %."""
    figures = (re.findall(rf"{name} +([\d.]+)", said) for name in ("cost", "distance"))
    return all(float(corrected) < 0.7 * float(alone) for alone, corrected in figures)


#: Script: what it needs beyond the core, its arguments, and what its output must show.
SCRIPTS = {
    "gymnasium_environment": (("sapien", "gymnasium"), [], r"success True"),
    "own_joint_law": (("sapien",), [], r"force by 0\.[5-9] N"),
    "own_hand": (("sapien",), [], r"KM: stalled .*\nE-KM: reached"),
    "own_task_and_wrapper": (("sapien",), [], r"^reached"),
    "own_learner_in_compare": (("matplotlib",), [], r"kernel average +0\.[1-6]"),
    "real_hand_driver": (("sapien",), [], r"^reached"),
    "record_and_replay": (("sapien", "h5py"), [], r"(trial_00000\d\.h5 ok.*\n){2}[\s\S]*trial 1: error"),
    "residual_mpc": (("casadi",), ["--quick"], learner_takes_cost_off),
}


def test_every_script_is_run() -> None:
    assert sorted(SCRIPTS) == sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.mark.usefixtures("unchecked")  # a learner's contract gives input that annotations forbid
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_script_runs(name, tmp_path, monkeypatch, capsys):
    needs, arguments, shows = SCRIPTS[name]
    for module in needs:
        pytest.importorskip(module)
    script = EXAMPLES / f"{name}.py"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    if name == "own_hand":  # whose check turns the pinch to its end, of which nothing is printed
        short = functools.partialmethod(ClosedLoop.reach, limit=math.radians(5.0))
        monkeypatch.setattr(ClosedLoop, "reach", short)
    runpy.run_path(str(script), run_name="__main__")
    said = capsys.readouterr().out
    assert shows(said) if callable(shows) else re.search(shows, said)
