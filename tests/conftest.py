"""Settings that all tests share."""

import gc
import os
import sys
from collections.abc import Iterator
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import annotations as shapes  # beside this file
import hypothesis
import jaxtyping
import pytest
import torch

_EXACT = (
    "test_benchmarks_drivers.py",  # so has the hand behind the bus
    "test_description_docs.py",  # figures are found within 10 %
    "test_simulation_hand.py",
    "test_simulation_model_agreement.py",
    "test_simulation_sensor_disturbances.py",
)

shapes.install()  # before anything imports the package
torch.set_num_threads(1)  # many small matrices: threads only get into each other's way
# examples are drawn from a fixed seed, and no clock decides on a slow machine
hypothesis.settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    from torch_ekm import warm_up  # behind the hook above

    warm_up()  # tests of bits must not depend on when loops are compiled
    gc.freeze()  # what is imported stays: the collector need not go through it again and again


@pytest.fixture
def generator() -> torch.Generator:
    """Seeded source of randomness."""
    return torch.Generator().manual_seed(7)


@pytest.fixture(autouse=True, scope="module")
def _coarse_time(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hands are simulated in steps of 2 ms, which takes half the time of the usual 1 ms.

    Tests of the simulated hand itself, and of the model against it, have the usual steps, and so has what
    runs in a process of its own.
    """
    module: Any = sys.modules.get("torch_ekm.simulation.config")  # if a collected test has it
    if module is None or request.path.name in _EXACT:
        yield
        return
    init = module.PlantConfig.__init__
    usual = init.__defaults__
    init.__defaults__ = tuple(0.002 if value == 1e-3 else value for value in usual)
    assert module.PlantConfig().time_step == 0.002
    yield
    init.__defaults__ = usual


@pytest.fixture(autouse=True)
def _checks_begin_again() -> None:
    shapes.begin_test()


@pytest.fixture
def unchecked(_checks_begin_again):
    """Annotations are not checked: the test passes what they forbid, to see the package's own error."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


class _NothingIsKnown(dict):
    def __contains__(self, key: object) -> bool:
        return False


@pytest.fixture
def planned_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pinch comes from an earlier grasp: the test compares a run with its repetition."""
    from torch_ekm.simulation.grasp_planning import pinch

    monkeypatch.setattr(pinch, "_plans", _NothingIsKnown())
