"""The Gymnasium environment of examples/gymnasium_environment.py; the example itself turns an object."""

import runpy
from pathlib import Path

import pytest

pytest.importorskip("sapien")
pytest.importorskip("gymnasium")


def test_it_passes_the_checks_of_gymnasium() -> None:
    from gymnasium.utils.env_checker import check_env

    example = Path(__file__).parents[2] / "examples" / "gymnasium_environment.py"
    made = runpy.run_path(str(example))["InHandRotation"](hand="planar_two_finger", preset="nominal")
    check_env(made, skip_render_check=True)
