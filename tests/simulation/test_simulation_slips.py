"""The witness of slips tells the truth."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from slips import Witness

from torch_ekm.description import load_object
from torch_ekm.simulation import SimulatedHand


def test_the_witness_explains_every_torque_and_sees_no_slip_at_rest():
    plant = SimulatedHand("icub_right", load_object("box"))
    try:
        plant.reset(0)
        witness = Witness(plant)
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
