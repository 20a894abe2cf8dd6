"""Experiments of these tests are simulated in steps of 2 ms, which takes half the time of the usual 1 ms."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest

from torch_ekm.experiments.config import Setting
from torch_ekm.simulation import PlantConfig


@pytest.fixture(scope="module", autouse=True)
def coarse_time() -> Iterator[None]:
    usual = Setting.plant_config

    def coarse(setting: Setting, controller: str) -> PlantConfig:
        return dataclasses.replace(usual(setting, controller), time_step=0.002)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Setting, "plant_config", coarse)
        yield
