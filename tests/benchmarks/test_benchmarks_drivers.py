"""A turn over a bus is the turn of the same hand in process."""

from __future__ import annotations

from importlib.util import find_spec

import drivers as module  # of benchmarks/
import pytest

pytest.importorskip("sapien")


@pytest.mark.parametrize("bus", module.BUSES, ids=lambda bus: bus.kind)
def test_the_same_hand_behind_a_bus_makes_the_same_turn(bus, tmp_path) -> None:
    if find_spec(bus.needs) is None:
        pytest.skip(f"{bus.needs} is not installed")
    # on a busy machine the emulated hand keeps its own bus waiting, which ends turns: then two more are tried
    assert module.turns(bus, tmp_path, 1)[0] or module.turns(bus, tmp_path, 3)[0]
