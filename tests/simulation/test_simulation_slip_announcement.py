"""The benchmark of announced slips runs, and its truth is one."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import slip_announcement as benchmark

from torch_ekm.description import load_object
from torch_ekm.simulation import SimulatedHand


def test_the_quick_run_prints_its_table():
    lines = benchmark.main(["--quick", "--seeds", "0:1"])
    assert "announced" in lines[0]
    assert sum(line.startswith(("sensed", "nominal")) for line in lines) == 6
    assert all("nan" not in line.split("|")[5] for line in lines if line.startswith(("sensed", "nominal")))


def test_the_witness_explains_every_torque_and_sees_no_slip_at_rest():
    plant = SimulatedHand("icub_right", load_object("box"))
    try:
        plant.reset(0)
        witness = benchmark.Witness(plant)
        margins = witness.margins()
        assert len(margins) == 3
        assert min(margins.values()) > 0
        assert witness.misfit < 0.1  # of 2 mN m, 10 mN, 20 mN
        plant.wait(0.2)
        assert max(witness.slips().values()) < 2e-6
        away = np.zeros(plant.hand.n_a)
        away[plant.hand.actuator_names.index("index_proximal")] = -0.3  # the index finger lets go
        plant.command(away)
        assert "index" not in witness.margins()
    finally:
        plant.close()
