"""Turns whose process is killed (SIGKILL) at random moments, and gone on with in another one.

    python benchmarks/killed_turns.py --hands light,sapien,mujoco,dynamixel --kills 50

The hand is no part of the process that is killed: it stands in this one, or behind an emulated bus.
Each time the journal must be whole, the hand must be held first, what was learned until the last motion must
be there, and the turn must begin again from where the hand stands and come to its target, or be refused with
a typed error.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gate import grasp
from light_plant import Obedient

from torch_ekm.control import (
    ClosedLoop,
    HandKnowledge,
    Journal,
    LookAndMoveController,
    PoseTarget,
    StopReason,
)
from torch_ekm.control.journal import _Turn
from torch_ekm.description import load_object
from torch_ekm.drivers import WithPose
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantWrapper, can_follow
from torch_ekm.simulation import SimulatedHand

sys.path.insert(0, str(Path(__file__).parent / "buses"))
from far_end import BUSES, HAND, OBJECT, opened

HERE = ("light", "sapien", "mujoco")  # in this process
HANDS = (*HERE, "dynamixel")
RIGHT = ("reached", "reached, before it was killed", "ResumeError")
_STANDS = 0.02  # [rad] that two readings of a hand at rest may differ


class Distant:
    """A plant at the other end of a pipe; it outlives the process that drives it."""

    def __init__(self, pipe: Connection, follows: bool) -> None:
        self._pipe = pipe
        if follows:
            self.follow = self._follow

    def reset(self, seed: int) -> Observation:
        return self._ask("reset", seed)

    def observe(self) -> Observation:
        return self._ask("observe")

    def command(self, delta_a: torch.Tensor) -> Observation:
        return self._ask("command", delta_a)

    def close(self) -> None:
        return

    def _follow(self, path: Any, watch: Callable[[Observation], bool]) -> Observation:
        return self._ask("follow", path, watch=watch)

    def _ask(self, name: str, *words: Any, watch: Callable[[Observation], bool] | None = None) -> Observation:
        self._pipe.send_bytes(pickle.dumps((name, words)))
        while True:
            ended, answer = pickle.loads(self._pipe.recv_bytes())
            if ended:
                return answer
            assert watch is not None
            self._pipe.send_bytes(pickle.dumps(watch(answer)))


def serve(pipe: Connection, plant: Plant) -> None:
    """The other end. A hand that nobody watches any more stands."""

    def watch(seen: Observation) -> bool:
        try:
            pipe.send_bytes(pickle.dumps((False, seen)))
            return pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return False

    with contextlib.suppress(EOFError, OSError):
        while True:
            name, words = pickle.loads(pipe.recv_bytes())
            answer = getattr(plant, name)(*words, *([watch] if name == "follow" else []))
            pipe.send_bytes(pickle.dumps((True, answer)))


class Untold(PlantWrapper):
    """What is simulated is not passed on with its truth: a reading must fit through a pipe."""

    def observation(self, seen: Observation) -> Observation:
        return replace(seen, truth=None)


class Recorded(PlantWrapper):
    """What was sent after a restart, and the newest reading at rest before and after each of it."""

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.sent: list[torch.Tensor] = []
        self.before: list[Observation | None] = []
        self.after: list[Observation] = []
        self._newest: Observation | None = None

    def observe(self) -> Observation:
        self._newest = super().observe()
        return self._newest

    def command(self, delta_a: torch.Tensor) -> Observation:
        return self._kept(delta_a, lambda: super(Recorded, self).command(delta_a))

    def _followed(self, path: Any, watch: Callable[[Observation], bool]) -> Observation:
        return self._kept(path.waypoints[-1], lambda: super(Recorded, self)._followed(path, watch))

    def _kept(self, sent: torch.Tensor, send: Callable[[], Observation]) -> Observation:
        self.sent.append(sent)
        self.before.append(self._newest)
        self._newest = send()
        self.after.append(self._newest)
        return self._newest


@dataclass
class Held:
    """A grasp of a hand that outlives the processes which drive it."""

    model: KinematicModel
    axis: torch.Tensor
    degrees: float
    grip: Callable[[], Observation]
    """Grasps again."""
    driven: Callable[[], contextlib.AbstractContextManager[Plant]]
    """In this process."""
    begun: Callable[[Callable[[Plant], None]], int]
    """In a new one, whose number it gives."""
    settle: Callable[[], None] = lambda: None
    """Waits until what was under way has ended."""

    def target(self, seen: Observation) -> PoseTarget:
        return PoseTarget.turned(seen.state, self.axis, degrees=self.degrees)

    def loop(self, plant: Plant, seen: Observation, learns: bool) -> ClosedLoop:
        model = EnhancedModel.for_grasp(self.model, seen.state) if learns else self.model
        knowledge = HandKnowledge.of(self.model.hand)
        return ClosedLoop(plant, LookAndMoveController(model, self.axis), knowledge=knowledge)


@contextmanager
def here(kind: str) -> Iterator[Held]:
    """A hand in this process: the light one, or one that an engine simulates."""
    if kind == "light":
        seen, axis, model = grasp("icub_right", "box")
        plant: Plant = Obedient(model, seen)
    else:
        hand = SimulatedHand("icub_right", "box", engine=kind)
        hand.reset(4)
        plant, axis, model = Untold(hand), hand.rotation_axis, KinematicModel(hand.hand, hand.object)
    server: list[threading.Thread] = []

    def begun(drive: Callable[[Plant], None]) -> int:
        near, far = multiprocessing.Pipe()
        child = forked(lambda: (near.close(), drive(Distant(far, can_follow(plant)))))
        far.close()
        server[:] = [threading.Thread(target=serve, args=(near, plant), daemon=True)]
        server[0].start()
        return child

    yield Held(model, axis, 20.0, lambda: plant.reset(4), lambda: contextlib.nullcontext(plant),
               begun, lambda: server[0].join())  # fmt: skip
    plant.close()


@contextmanager
def behind() -> Iterator[Held]:
    """A simulated hand behind an emulated bus."""
    bus = BUSES[0]
    with tempfile.TemporaryDirectory() as folder, opened(bus, Path(folder), "hand") as (end, path):
        model = KinematicModel(SimulatedHand(HAND, OBJECT).hand, load_object(OBJECT))

        @contextmanager
        def driven() -> Iterator[Plant]:
            with bus.driver(path) as driver:
                yield WithPose(driver, end, lost=end.lost)

        def grip() -> Observation:
            end.ask("reset 1000")
            with driven() as plant:
                return plant.reset(1000)

        def begun(drive: Callable[[Plant], None]) -> int:
            def child() -> None:
                with driven() as plant:
                    drive(plant)

            return forked(child)

        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        yield Held(model, axis, 8.0, grip, driven, begun, end.resume)


def forked(work: Callable[[], object]) -> int:
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            work()
        os._exit(0)
    return child


def killed(held: Held, share: float, learns: bool, folder: Path, longest: float) -> tuple[int, str]:
    """A turn, killed after a share of ``longest`` [s], and resumed: motions until then, what came of it.

    Raises:
        AssertionError: the files are not whole, the hand is not held first, it goes on from elsewhere, or
            what was learned until the last motion is not there.
    """
    seen = held.grip()
    journal = Journal(folder / "turn.ekm")
    child = held.begun(lambda plant: journal.run(held.loop(plant, seen, learns), held.target(seen)))
    while not journal.path.exists():
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "it ended before it began"
        time.sleep(0.002)
    time.sleep(share * longest)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    held.settle()
    written = journal._read()
    if not journal.cut_short:
        return written.motions, f"{written.reason}, before it was killed"
    return written.motions, resumed(held, journal, written, seen, learns)


def resumed(held: Held, journal: Journal, written: _Turn, seen: Observation, learns: bool) -> str:
    """How a turn that was killed ends."""
    with held.driven() as plant:
        recorded = Recorded(plant)
        loop = held.loop(recorded, seen, learns)
        forgotten = loop.knowledge.servo.weight.clone()
        try:
            result = journal.resume(loop)
        except EKMError as error:
            return type(error).__name__
    kept = written.learned["knowledge.servo.weight"]
    assert not (written.motions and learns and torch.equal(kept, forgotten)), "nothing was kept"
    assert recorded.after, "it does not hold"
    assert not bool(recorded.sent[0].any()), "it does not hold first"
    for begins in recorded.before[1:2]:
        away = math.inf if begins is None else float((begins.a - recorded.after[0].a).abs().max())
        assert away < _STANDS, f"it goes on from elsewhere, {away:.3f} rad away"
    why = f": {result.stop.message}" if result.reason is StopReason.PLANT_FAILED else ""
    return result.reason.value + why


def whole(held: Held, seen: Observation) -> float:
    """How long a turn back takes [s]; the way there loads more."""
    with held.driven() as plant:
        held.loop(plant, seen, True).run(held.target(seen))
        there, began = plant.observe(), time.monotonic()
        back = PoseTarget.turned(there.state, held.axis, degrees=-held.degrees)
        held.loop(plant, there, True).run(back)
        return time.monotonic() - began


def kills(kind: str, n: int, seed: int = 1000) -> Counter[str]:
    """What came of ``n`` turns of a hand that were killed at random moments."""
    draw, ends = np.random.default_rng(seed), Counter[str]()
    with here(kind) if kind in HERE else behind() as held:
        longest = whole(held, held.grip())
        for k in range(n):
            moment = draw.uniform(0.0, 1.0)
            with tempfile.TemporaryDirectory() as folder:
                try:
                    motions, end = killed(held, moment, k % 2 == 0, Path(folder), longest)
                except AssertionError as error:
                    motions, end = -1, str(error)
            ends[end] += 1
            print(f"{kind} {k}: after {motions} motions, {end}", file=sys.stderr, flush=True)
    return ends


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--hands", default=",".join(HANDS))
    arguments.add_argument("--kills", type=int, default=50, help="of each")
    given = arguments.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    parts = []
    for kind in given.hands.split(","):
        ends = kills(kind, given.kills)
        right = sum(ends[end] for end in RIGHT)
        print(f"{kind}: {', '.join(f'{n} {reason}' for reason, n in ends.most_common())}")
        parts.append(f"{kind} {right}/{given.kills}")
    print(f"killed turns resumed, or refused as they should be: {', '.join(parts)}")


if __name__ == "__main__":
    main()
