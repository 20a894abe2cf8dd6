"""The Hall sensors' fit, joint by joint, for the question ``sensing`` of the matrix."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from torch_ekm.description import load_hand
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.reporting.report import Cell, Column, Table
from torch_ekm.sensing import HallCalibration
from torch_ekm.simulation import HallSensors

_DEG = math.pi / 180


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def hall_table(trials: Any) -> Table:
    """Errors of the calibrated channels over a second sweep: a row for each joint, all hands together."""
    hand, found = load_hand(Setting().hand), {}
    for seed in dict.fromkeys(trials["seed"]):
        sensors, draw = HallSensors(hand, seed), torch.Generator().manual_seed(0)
        calibration = HallCalibration.fit(*sensors.sweep(181, draw), sensors.joints)
        counts, angles = sensors.sweep(1000, draw)
        read = calibration.estimate(counts)
        for k, channel in enumerate(calibration.channels):
            valid = read.valid[:, k]
            wrong, stated = (read.q - angles)[valid, k] / _DEG, read.std[valid, k] / _DEG
            found.setdefault(channel.joint, []).append(
                (
                    _rms(wrong.tolist()),
                    float(wrong.abs().max()),
                    _rms(stated.tolist()),
                    float((~valid).double().mean()),
                )
            )
    columns: dict[Column, Callable[[Any], Cell]] = {
        Column("fit, rms [deg]"): lambda of: _rms(one[0] for one in of),
        Column("largest [deg]"): lambda of: max(one[1] for one in of),
        Column("stated sd [deg]"): lambda of: _rms(one[2] for one in of),
        Column("no reading [%]", ".0f", percent=True): lambda of: float(np.mean([one[3] for one in of])),
    }
    note = "Over a second sweep of the whole range; no reading: share of it where the channel is saturated."
    return Table.of("hall", "Hall fit of each joint", "joint", found, columns, note)
