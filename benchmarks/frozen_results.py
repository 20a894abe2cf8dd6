"""Results before a change of structure and after it: the same to rounding, or which differ.

    python benchmarks/frozen_results.py --write before.json     # on the version before
    python benchmarks/frozen_results.py --against before.json   # on the version after

The demo on two seeds, one short session of each protocol, J_m on twenty states, learners on three streams.
Figures are compared one by one, times are left out; a part that one of the versions lacks is named.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parent / "studies"))

from ablation import Ablation
from foresight_study import Foresight

from torch_ekm.experiments.learners import LEARNERS, PEERS
from torch_ekm.experiments.protocols.demo import Demo
from torch_ekm.experiments.reproduce import PROTOCOLS
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import PlantConfig, PlantParameters, SimulatedHand

#: Relative, and absolute in deg, mm or N.
TOLERANCE = 1e-9
STATES = {"box": 10, "can": 10}
SAMPLES, INPUTS, OUTPUTS = 150, 3, 2
TIMES = ("seconds",)


def streams() -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """A smooth map, one that drifts, and one with outliers."""
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(SAMPLES, INPUTS, dtype=torch.float64, generator=draw)
    y = torch.stack([torch.sin(x.sum(-1)), x[:, 0] * x[:, 1]], -1)
    y = y + 0.05 * torch.randn(y.shape, dtype=torch.float64, generator=draw)
    drift = y + torch.linspace(0, 1, SAMPLES, dtype=torch.float64)[:, None]
    wild = y + 8.0 * (torch.rand(SAMPLES, 1, dtype=torch.float64, generator=draw) < 0.04)
    return {"smooth": (x, y), "drifting": (x, drift), "outliers": (x, wild)}


def learner_on(name: str, x: torch.Tensor, y: torch.Tensor) -> list[Any]:
    """Predictions before each update, mean and variance."""
    torch.manual_seed(0)
    learner = LEARNERS[name](INPUTS, OUTPUTS, n_actions=1, capacity=20)
    seen = []
    for one, target in zip(x, y, strict=True):
        prediction = learner.predict(one)
        seen.append([prediction.mean.tolist(), prediction.variance.tolist()])
        learner.update(one, target)
    return seen


def jacobians(name: str, number: int) -> list[Any]:
    """J_m at simulated grasps."""
    hand = SimulatedHand("icub_right", name, PlantConfig(), PlantParameters())
    model = KinematicModel(hand.hand, hand.object)
    return [model.linearize(hand.reset(seed).state).manipulation_jacobian.tolist() for seed in range(number)]


def parts() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and figures of each part, not yet computed."""
    demo = Demo()
    for job in demo.jobs((0, 1)).values():
        yield f"demo {job[1:]}", lambda job=job: demo.run(*job)
    for name, kind in {**PROTOCOLS, "ablation": Ablation, "foresight": Foresight}.items():
        quick = kind().quick()
        for number, job in enumerate(list(quick.jobs((0,)).values())[:4]):
            yield f"{name} {number}", lambda quick=quick, job=job: quick.run(*job)
    for name, number in STATES.items():
        yield f"J_m {name}", lambda name=name, number=number: jacobians(name, number)
    for stream, (x, y) in streams().items():
        for name in LEARNERS:
            if name not in PEERS:
                yield f"{name} on {stream}", lambda name=name, x=x, y=y: learner_on(name, x, y)


def differences(ours: Any, theirs: Any, place: str = "") -> Iterator[str]:
    """Places whose figures differ."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in sorted(ours.keys() | theirs.keys()):
            if key not in TIMES:
                yield from differences(ours.get(key), theirs.get(key), f"{place}.{key}")
    elif isinstance(ours, list | tuple) and isinstance(theirs, list | tuple) and len(ours) == len(theirs):
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            yield from differences(a, b, f"{place}[{k}]")
    elif isinstance(ours, float | int) and isinstance(theirs, float | int):
        if not (math.isclose(ours, theirs, rel_tol=TOLERANCE, abs_tol=TOLERANCE) or ours != ours != theirs):
            yield f"{place}: {ours} and {theirs}"
    elif ours != theirs:
        yield f"{place}: {ours!s:.60} and {theirs!s:.60}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", default="", help="parts whose name contains this")
    chosen = parser.parse_args()
    before = json.loads(chosen.against.read_text()) if chosen.against else {}
    results: dict[str, Any] = {}
    differ = 0
    for name, compute in parts():
        if chosen.only not in name:
            continue
        results[name] = json.loads(json.dumps(compute()))
        found = list(differences(results[name], before[name], name)) if name in before else []
        differ += len(found)
        message = (
            "" if not chosen.against else "not there before" if name not in before else f"{len(found)} differ"
        )
        print(f"{name}: {message}", *found[:5], sep="\n  ", flush=True)
    if chosen.write:
        chosen.write.write_text(json.dumps(results))
    if chosen.against:
        gone = [name for name in before if name not in results and chosen.only in name]
        print(f"{differ} figures differ, in {len(results)} parts; gone: {', '.join(gone) or 'none'}")
        raise SystemExit(bool(differ))


if __name__ == "__main__":
    main()
