"""Hands are simulated in steps of 2 ms, which takes half the time of the usual 1 ms.

Tests of the simulated hand itself, and of the model against it, have the usual steps, and so has what runs in
a process of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_EXACT = (
    "test_benchmarks_drivers.py",  # so has the hand behind the bus
    "test_description_docs.py",  # figures are found within 10 %
    "test_simulation_hand.py",
    "test_simulation_model_agreement.py",
    "test_simulation_sensor_disturbances.py",
)


@contextmanager
def steps_for(file: str) -> Iterator[None]:
    """The default of ``PlantConfig.time_step`` is 2 ms in most files, if a collected test has that class."""
    module: Any = sys.modules.get("torch_ekm.simulation.config")
    if module is None or file in _EXACT:
        yield
        return
    init = module.PlantConfig.__init__
    usual = init.__defaults__
    init.__defaults__ = tuple(0.002 if value == 1e-3 else value for value in usual)
    assert module.PlantConfig().time_step == 0.002
    yield
    init.__defaults__ = usual
