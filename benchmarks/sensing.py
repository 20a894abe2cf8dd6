"""The paper's sensing in simulation: what each reading is worth, the Hall fit, the calibration of the lens.

    python benchmarks/sensing.py --objects box,can --seeds 1000:1010 --out FOLDER

Every hand (seed) has Hall channels, a lens and motors of its own. The lens is calibrated by OpenCV from
pictures of a ChArUco board. An E-KM makes three turns with each object, then those that are counted: with
everything sensed, and with one reading at a time replaced by the truth, or by a worse camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from contenders import Contender
from matrix import Frame, Question, ask
from questions import BY_HAND
from sessions import turns
from simulated_hand.lens import LENSES, DistortingCamera, calibrated, lens_of
from simulated_hand.tracking_accuracy import measure_tracking

from torch_ekm._extras import require
from torch_ekm.description import load_hand
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.reporting.report import Cell, Column, Table
from torch_ekm.experiments.runner import Bench
from torch_ekm.sensing import ContactAligned, HallCalibration, MarkerTracker
from torch_ekm.simulation import HallSensors, SensedPlant

_DEG = math.pi / 180


class ReadBench(Bench):
    """A bench whose poses come through a lens, and whose joints from Hall counts."""

    lens: str | None = "20 pictures"
    """How the tracker knows its lens; None: true poses."""
    hall = True

    def __init__(self, setting: Setting, object: str, controller: str) -> None:
        plant, seed = setting.parameters, setting.parameters.hardware_seed
        plant = plant if self.hall else plant.replace(joint_noise=0.0)
        plant = plant if self.lens else plant.replace(position_noise=0.0, rotation_noise=0.0)
        super().__init__(setting.replace(plant=plant), object, controller)
        if self.lens is not None:
            require("cv2").setNumThreads(1)
            hand, held = self.hand.hand, self.hand.object
            sensed = SensedPlant(self.plant, hand, held, HallSensors(hand, seed) if self.hall else None)
            sensed.camera = DistortingCamera(lens_of(seed))
            sensed.tracker = MarkerTracker(LENSES[self.lens](seed), *sensed.boards)
            self.plant = ContactAligned(sensed, hand, held) if self.hall else sensed


class TrueJoints(ReadBench):
    """Joint angles are true."""

    hall = False


class ExactLens(ReadBench):
    """The lens is known."""

    lens = "exact"


class Uncalibrated(ReadBench):
    """The lens is taken for that of the data sheet."""

    lens = "not calibrated"


class AllTrue(ReadBench):
    """No noise of poses and joints."""

    lens, hall = None, False


READINGS = {
    "all sensed": Contender("E-KM", {}, ReadBench),
    "true joint angles": Contender("E-KM", {}, TrueJoints),
    "lens exact": Contender("E-KM", {}, ExactLens),
    "lens not calibrated": Contender("E-KM", {}, Uncalibrated),
    "all true": Contender("E-KM", {}, AllTrue),
    "KM, all sensed": Contender("KM", {}, ReadBench),
}


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def hall_table(trials: Frame) -> Table:
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


def lens_table(trials: Frame, frames: int = 20) -> Table:
    """What a calibration leaves: poses of boards in random poses, all lenses together."""
    found: dict[str, list[Any]] = {name: [] for name in LENSES}
    for seed in dict.fromkeys(trials["seed"]):
        true, camera = lens_of(seed), DistortingCamera(lens_of(seed))
        for name, known_as in LENSES.items():
            known = known_as(seed)
            found[name].append(
                (100 * abs(known.fx / true.fx - 1), measure_tracking(frames, seed, camera, known))
            )
    figures = {
        "depth [mm]": "depth_mm",
        "position [mm]": "object_position_mm",
        "rotation [deg]": "object_rotation_deg",
    }

    def rms(figure: str, of: Any) -> float:
        return _rms(getattr(one[1], figure) for one in of)

    columns: dict[Column, Callable[[Any], Cell]] = {
        Column("focal length [%]"): lambda of: _rms(one[0] for one in of),
        **{Column(name): partial(rms, figure) for name, figure in figures.items()},
    }
    left = _rms(calibrated(seed).reprojection for seed in dict.fromkeys(trials["seed"]))
    note = f"rms over lenses; ChArUco pictures, {left:.2f} px reprojection; print and sheet have no errors."
    return Table.of("lenses", "Camera calibration", "lens", found, columns, note)


SENSING = Question(
    "sensing",
    "What each reading is worth",
    turns,
    READINGS,
    options=BY_HAND,
    columns=(
        "turns", "lost", "reached", "error [deg]", "by the E-KM [deg]", "joints off by [deg]",
        "motors off by [deg]",
    ),
    split="object",
    more=(hall_table, lens_table),
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    ask(SENSING, arguments, __doc__)


if __name__ == "__main__":
    main()
