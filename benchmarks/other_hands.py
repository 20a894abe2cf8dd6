"""Other people's hands: are they read, do they pinch, do they turn what they hold?

    python benchmarks/other_hands.py FOLDER [--engine mujoco] [--object can] [--degrees 8] [--picture FILE]

Each ``.urdf``, ``.xml`` and ``.mjcf`` in the folder is a described hand, with its transmission file next to
it. Where there is none, nine hands of kinds that owners have are written there. The last line counts them.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from made_hands import write_hands

import torch_ekm
from torch_ekm.control import ClosedLoop, LookAndMoveController, PoseTarget
from torch_ekm.description import HandDescription, load_hand
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError
from torch_ekm.experiments.reporting.plots import new_figure
from torch_ekm.kinematics import GraspState, HandKinematics
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


def draw_pinches(paths: list[Path], obj: str, engine: str, seed: int, file: Path) -> None:
    """The hands that pinch an object of cylinders, seen along the axis about which it is turned: lines from
    joint to joint, pads, and the ends of the cylinders."""
    held: list[tuple[str, SimulatedHand, GraspState]] = []
    for path in paths:
        with contextlib.suppress(EKMError):
            plant = SimulatedHand(load_hand(path), obj, engine=engine)
            held.append((path.stem, plant, plant.reset(seed).state))
    rows = -(-len(held) // 6)
    figure, grid = new_figure(12, 2.1 * rows, 6, rows)
    for axes in grid:
        axes.set(aspect="equal")
        axes.set_axis_off()
    around = np.linspace(0, 2 * np.pi, 60)
    circle = np.array([np.cos(around), np.sin(around), np.zeros(60)])
    for (name, plant, state), axes in zip(held, grid, strict=False):
        across = np.linalg.svd(plant.rotation_axis.numpy()[None])[2][1:]
        poses = HandKinematics(plant.hand)(state.q)
        joints = [one for one in plant.hand.urdf.joints if {one.parent, one.child} <= {*poses.link_names}]
        bones = [
            np.array([poses.of(link)[:3, 3].numpy() for link in (one.parent, one.child)]) for one in joints
        ]
        for pad in plant.hand.pads:
            T = poses.of(pad.link).numpy()
            ends = np.array([pad.start, pad.end]) @ T[:3, :3].T + T[:3, 3]
            bones.append(np.array([T[:3, 3], ends[0]]))
            axes.plot(*across @ ends.T, "o-", ms=4, color="C0")
        for bone in bones:
            axes.plot(*across @ bone.T, "k-", lw=1)
        for shape in plant.object.shapes:
            radius, length = shape.size
            for end in (-length / 2, length / 2):
                ring = (
                    shape.transform[:3, :3] @ (radius * circle + [[0], [0], [end]]) + shape.transform[:3, 3:]
                )
                seen = state.rotation.numpy() @ ring + state.position.numpy()[:, None]
                axes.plot(*across @ seen, color="C1", lw=1)
        axes.set_title(name)
        plant.close()
    figure.savefig(file)


def main(arguments: list[str] | None = None) -> list[Outcome]:
    """Try every hand, a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--engine", default="mujoco")
    parser.add_argument("--object", default="can")
    parser.add_argument("--degrees", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--picture", type=Path, help="draws the pinches into this file, and does nothing else"
    )
    given = parser.parse_args(arguments)
    if given.picture is not None:
        draw_pinches(hands_in(given.folder), given.object, given.engine, given.seed, given.picture)
        return []
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
