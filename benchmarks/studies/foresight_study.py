"""Foresight: how far an object can be turned, whether that was predicted, and a turn that nobody looks at.

    python benchmarks/studies/foresight_study.py --seeds 1000:1010 --out FOLDER

With 20 seeds, 280 sessions of 6 to 10 turns: an hour on two cores. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

sys.path.insert(0, str(Path(__file__).parents[1]))
from foresight_report import foresight_report
from foresight_turn import ForesightTurn
from oracle import OracleBench
from run_study import run_study

from torch_ekm.control import Reach
from torch_ekm.exceptions import GraspError, ParameterError
from torch_ekm.experiments.config import Setting, digest, object_name
from torch_ekm.experiments.protocols.generalize import OTHER_ANGLES, TABLE_I
from torch_ekm.experiments.protocols.protocol import Protocol
from torch_ekm.experiments.records import NotGrasped, Record, Trial, TrialRecord, true_state
from torch_ekm.experiments.reporting.report import Report
from torch_ekm.experiments.reporting.statistics import DataFrame
from torch_ekm.experiments.runner import Bench

_DEG = math.pi / 180
_FIRST_WARM_UP, _FAR, _BLIND = 1000, 3000, 4000  # numbers of the grasps
WIDE = ("tea_tin", "jar")
#: Who is compared: name -> bench, and its controller.
CONTENDERS: dict[str, tuple[type[Bench], str]] = {
    "E-KM": (Bench, "E-KM"),
    "oracle": (OracleBench, "KM+S"),
}


@dataclass(frozen=True)
class Foresight(Protocol):
    """Each object with each contender on the same grasps: blind, as far as it goes, and beyond Table I.

    A session is one object, one contender and one seed. A learner begins it empty and has ``warm_up`` turns
    of ``blind_angle_deg`` on grasps that are not tested. Before each turn the model is asked how far it goes;
    the answer is written down and changes nothing.

    Raises:
        ParameterError: no object, or a figure that is none.
        UnknownNameError: no such contender; the message lists them.
    """

    setting: Setting = field(default_factory=Setting)
    objects: tuple[str, ...] = (*TABLE_I, *WIDE)
    contenders: tuple[str, ...] = tuple(CONTENDERS)
    far_deg: float = 70.0
    """Farther than any grasp goes; 0: left out."""
    factor: float = 1.2
    """Of Table I's angles; 0: left out."""
    blind_angle_deg: float = 15.0
    look_again_deg: float = 0.35
    """Standard deviation about the axis at which the camera is asked, in the turns that look again."""
    warm_up: int = 3

    record: ClassVar[type[TrialRecord]] = ForesightTurn
    quick_seeds: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if not self.objects:
            raise ParameterError("objects", self.objects, "at least one object")
        for name in self.contenders:
            if name not in CONTENDERS:
                raise ParameterError("contenders", name, f"among {', '.join(CONTENDERS)}")
        if not 0 < self.blind_angle_deg < 170 or not self.look_again_deg > 0:
            figures = (self.blind_angle_deg, self.look_again_deg)
            raise ParameterError("blind_angle_deg, look_again_deg", figures, "an angle, and greater than 0")

    def angles_of(self, object: str) -> tuple[float, ...]:
        """Rotations beyond Table I [deg]."""
        return tuple(self.factor * angle for angle in TABLE_I.get(object, OTHER_ANGLES) if self.factor)

    def quick(self) -> Self:
        """One wide object, one contender, one turn of training."""
        small = {"far_deg": 40.0, "factor": 0.0, "blind_angle_deg": 6.0, "warm_up": 1}
        return dataclasses.replace(self, objects=("tea_tin",), contenders=("E-KM",), **small)

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[str, str, int]]:
        """One for each seed, object and contender."""
        alone = {
            **vars(self),
            "objects": (),
            "contenders": (),
        }  # a job does not depend on which others there are
        own = {item: digest(self.setting, (item,), alone, self.angles_of(item)) for item in self.objects}
        return {
            f"foresight_{own[item]}_{object_name(item)}_{name.replace(' ', '_')}_{seed}": (item, name, seed)
            for seed in seeds
            for item in self.objects
            for name in self.contenders
        }

    def session(self, object: str, contender: str, seed: int) -> list[Record]:
        """Warm-up, camera off (not the oracle, which sees all), as far as it goes, beyond Table I."""
        make, controller = CONTENDERS[contender]
        bench = make(self.setting.hardware_instance(seed), object, controller)
        if bench.learns:
            for k in range(self.warm_up):
                bench.trial(seed, _FIRST_WARM_UP + k, self.blind_angle_deg, "warm-up")

        def turn(kind: str, trial: int, angle: float, **options: Any) -> Record:
            start = bench.grasp(seed, trial)
            about = Trial(bench.name, kind, controller, seed, trial, angle)
            if start is None:
                return NotGrasped(**vars(about), message=bench.no_grasp)
            reach = None if kind.startswith("blind") else reach_of(bench, angle)
            return self._record(bench, contender, bench.turn(about, start, **options), reach)

        records = []
        if contender != "oracle":  # before anything more is learned
            dark = {"learn": False, "blind_deg": math.inf}
            records.append(turn("blind", _BLIND, self.blind_angle_deg, touch=True, **dark))
            again = {"touch": True, "look_again": self.look_again_deg * _DEG}
            records.append(turn("blind, looks again", _BLIND, self.blind_angle_deg, **again, **dark))
            records.append(turn("blind, no touch", _BLIND, self.blind_angle_deg, **dark))
        if self.far_deg:
            records.append(turn("far", _FAR, self.far_deg))
        records += [turn("turn", trial, angle) for trial, angle in enumerate(self.angles_of(object))]
        bench.close()
        return records

    def _record(self, bench: Bench, contender: str, done: TrialRecord, reach: Reach | None) -> ForesightTurn:
        assert bench.last is not None  # of this turn
        axis, last = bench.hand.rotation_axis, bench.last.stop.final
        seen = [*(step.before for step in bench.last.steps), last]
        sign = math.copysign(1.0, done.angle_deg)
        held = seen[:-1] if done.lost and len(seen) > 1 else seen
        angles = [sign * float(axis @ true_state(at).minus(true_state(seen[0]))[-3:]) for at in held]
        stated = last.info.get("estimate", {})
        dark: dict[str, Any] = {}
        if "axis_std" in stated:
            error = float(axis @ last.state.minus(true_state(last))[-3:])
            looks = sum(at.info.get("estimate", {}).get("looked", False) for at in seen)
            dark = {
                "axis_std_deg": stated["axis_std"] / _DEG, "estimate_error_deg": error / _DEG, "looks": looks,
            }  # fmt: skip
        if reach is not None:
            dark |= {"reach_deg": sign * reach.angle / _DEG, "reach_end": str(reach.end)}
        return ForesightTurn(**vars(done), contender=contender, largest_deg=max(angles) / _DEG, **dark)

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Answer, tables and figures."""
        return foresight_report(seeds, trials, folder)


def reach_of(bench: Bench, angle_deg: float) -> Reach | None:
    """How far the model says that the grasp turns, up to ``angle_deg``; None: it refuses the grasp."""
    sign, limit = (1 if angle_deg > 0 else -1), abs(angle_deg) * _DEG
    try:
        return bench.closed_loop(bench.plant).reach(sign=sign, limit=limit)
    except GraspError:
        return None


if __name__ == "__main__":
    run_study(Foresight(), __doc__)
