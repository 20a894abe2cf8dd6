"""Other people's hands: are they read, do they pinch, do they turn what they hold?

    python benchmarks/other_hands.py FOLDER [--engine mujoco] [--object can] [--degrees 8]

Each ``.urdf``, ``.xml`` and ``.mjcf`` in the folder is a described hand, with its transmission file next to
it. Where there is none, nine hands of kinds that owners have are written there. The last line counts them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

from made_hands import write_hands

import torch_ekm
from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.description import HandDescription, load_hand
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError
from torch_ekm.model import KinematicModel
from torch_ekm.plant import PlantStatus
from torch_ekm.simulation import SimulatedHand

_WITHIN = 0.3  # [deg] of a turn that is reached
_STEPS = ("read", "pinched", "turned", "lost")
_ENDINGS = (".urdf", ".xml", ".mjcf")


class Outcome(NamedTuple):
    """How far one hand came."""

    name: str
    read: bool = False
    pinched: bool = False
    turned: bool = False
    lost: bool = False
    said: str = ""
    """What it was that went wrong, or how far off it is."""


def hands_in(folder: Path) -> list[Path]:
    """The described hands of a folder, in order; nine that are written first if there are none."""
    found = sorted(path for path in folder.glob("*") if path.suffix in _ENDINGS)
    return found or sorted(write_hands(folder))


def try_hand(path: Path, obj: str, engine: str, degrees: float, seed: int) -> Outcome:
    """Read, pinch and turn, each only after the one before."""
    outcome = Outcome(path.stem)
    try:
        hand = load_hand(path)
        outcome = outcome._replace(read=True)
        return _turned(outcome, hand, obj, engine, degrees, seed)
    except EKMError as error:
        return outcome._replace(said=str(error))


def _turned(
    outcome: Outcome, hand: HandDescription, obj: str, engine: str, degrees: float, seed: int
) -> Outcome:
    plant = SimulatedHand(hand, obj, preset="nominal", engine=engine)
    try:
        seen = plant.reset(seed)
        outcome = outcome._replace(pinched=True)
        model = EnhancedModel.for_grasp(KinematicModel(hand, plant.object), seen.state)
        loop = ClosedLoop(plant, LookAndMoveController(model, focus=plant.rotation_axis))
        result = loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=degrees))
        off = math.degrees(float(result.errors[-1])) if len(result.errors) else degrees
        lost = plant.status is PlantStatus.LOST
        said = f"{result.reason.value}, {len(result.steps)} motions, {off:.2f} deg off {result.stop.message}"
        return outcome._replace(turned=off <= _WITHIN and not lost, lost=lost, said=said)
    except EKMError as error:
        return outcome._replace(lost=outcome.pinched and plant.status is PlantStatus.LOST, said=str(error))
    finally:
        plant.close()


def main(arguments: list[str] | None = None) -> list[Outcome]:
    """Try every hand, a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--engine", default="mujoco")
    parser.add_argument("--object", default="can")
    parser.add_argument("--degrees", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch_ekm.warm_up()
    outcomes = []
    for path in hands_in(given.folder):
        begun = time.process_time()
        one = try_hand(path, given.object, given.engine, given.degrees, given.seed)
        outcomes.append(one)
        steps = ", ".join(name for name in _STEPS if getattr(one, name)) or "not read"
        print(f"{one.name}: {steps}; {one.said} ({time.process_time() - begun:.0f} s)")
    counts = (f"{name} {sum(getattr(one, name) for one in outcomes)}" for name in _STEPS)
    print(f"hands {len(outcomes)}, {', '.join(counts)}")
    return outcomes


if __name__ == "__main__":
    main(sys.argv[1:])
