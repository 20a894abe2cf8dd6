"""What a hand is doing, on disk: a process that is killed in mid-turn is started again, and goes on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any, NamedTuple

import torch

from .._arrays import as_tensors
from .._checks import check_count, check_finite, check_kind, check_shape
from .._recorded import check_state
from ..exceptions import FileFormatError, OutputError, ResumeError
from ..plant import Observation, PlantStatus
from ..residual.files import read, write
from .closed_loop import ClosedLoop
from .decision import Manipulation, Step, Stop
from .focus import PoseTarget
from .guards import deg
from .rehearsal import LONGEST

_KIND = "turn under way"


class _Turn(NamedTuple):
    """What a journal says."""

    learned: dict[str, Any]
    target: PoseTarget
    actuators: list[str]
    a: torch.Tensor
    """Where the motors stood [rad]."""
    pose: PoseTarget | None
    """Where the object was; None: it was not seen."""
    motions: int
    reason: str
    """Why the turn ended; "": it has not."""


class Journal:
    """One file, written whole before the first motion and after each: target, where the hand stood, and what
    was learned until then. ::

        journal = Journal("turn.ekm")
        result = journal.run(loop, target)

    and where that process was killed, in the next one::

        loop = ClosedLoop(plant, controller)  # made as before; what was learned comes from the file
        result = journal.resume(loop) if journal.cut_short else journal.run(loop, target)

    Args:
        path: of the file.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        self._left: tuple[int, int] | None = None  # the file as it was written here

    @property
    def cut_short(self) -> bool:
        """There is a turn that did not come to its end.

        Raises:
            FileFormatError: the file is no journal.
        """
        return os.path.exists(self.path) and not self._read().reason

    def run(self, loop: ClosedLoop, target: PoseTarget) -> Manipulation:
        """As :meth:`ClosedLoop.run`.

        Raises:
            FileFormatError: there is a file that is no journal; it is left, and nothing moves.
            OutputError: the file cannot be written, or another turn is; the hand holds.
        """
        return Manipulation.of(target, loop.controller.focus, self.steps(loop, target))

    def steps(self, loop: ClosedLoop, target: PoseTarget) -> Generator[Step, None, Stop]:
        """As :meth:`ClosedLoop.steps`."""
        if os.path.exists(self.path):
            self._read()
        self._left = None
        self._write(loop, target, loop.plant.observe(), 0)
        with contextlib.closing(loop.steps(target)) as motions:
            k = 0
            while True:
                try:
                    step = next(motions)
                except StopIteration as end:
                    stop: Stop = end.value
                    self._write(loop, target, stop.final, k, stop.reason.value)
                    return stop
                k += 1
                self._write(loop, target, step.after, k)
                yield step

    def resume(self, loop: ClosedLoop) -> Manipulation:
        """Hold, take over what was learned, and go on to the target of the file.

        Raises:
            ResumeError: there is nothing to go on with, the hand is another one, it has lost its object, or
                it stands farther from where the file has it than one motion goes. It holds, and nothing is
                taken over.
            StateMismatchError: the learner is another one than before.
            EKMError: what the plant raises.
        """
        loop.hold()
        known, here = self._read(), loop.plant.observe()
        against = self._against(loop, known, here)
        if against:
            raise ResumeError(self.path, against)
        check_state(loop.learned, known.learned)
        loop.learned.load_state_dict(known.learned)
        return Manipulation.of(known.target, loop.controller.focus, self.steps(loop, known.target))

    def _against(self, loop: ClosedLoop, known: _Turn, here: Observation) -> str:
        """Why the turn is not gone on with; empty: it is."""
        hand, guards = loop.controller.kinematic.hand, loop.safety.guards
        if known.reason:
            return f"the turn came to its end: {known.reason}"
        if known.actuators != list(hand.actuator_names):
            return f"it is of a hand with the actuators {', '.join(known.actuators)}"
        if here.status is PlantStatus.LOST:
            return "the object is lost: grasp it again"
        way, most = (here.a - known.a).abs(), max(LONGEST, guards.increment) + guards.encoder_jump
        if float(way.max()) > most:
            stands = f"encoder '{hand.actuator_names[int(way.argmax())]}' stands {deg(way.max())}"
            return f"{stands} from where it was ({deg(most)} are one motion): begin a new turn"
        if here.status is PlantStatus.NOT_SEEN:
            return "" if known.pose else "the object was not seen, neither then nor now: clear the view"
        if known.pose is None:
            return ""
        off = known.pose.error(here.state)
        shift, turn = (float(torch.linalg.vector_norm(part)) for part in (off[:3], off[3:]))
        if shift > guards.translation_jump or turn > guards.rotation_jump:
            return f"the object is {1e3 * shift:.0f} mm and {deg(turn)} from where it was: begin a new turn"
        return ""

    def _write(
        self, loop: ClosedLoop, target: PoseTarget, seen: Observation, motions: int, reason: str = ""
    ) -> None:
        state = {
            "learned": dict(loop.learned.state_dict()),
            "target": {"position": target.position, "rotation": target.rotation},
            "seen": {
                "a": seen.a, "position": seen.position, "rotation": seen.rotation,
                "seen": seen.status is PlantStatus.HELD,
            },
            "motions": motions,
            "reason": reason,
            "actuators": list(loop.controller.kinematic.hand.actuator_names),
        }  # fmt: skip
        if self._left and self._stamp() not in (None, self._left):
            raise OutputError(self.path, "another turn is written there, too")
        write(self.path, {"class": _KIND}, state)
        self._left = self._stamp()

    def _stamp(self) -> tuple[int, int] | None:
        with contextlib.suppress(FileNotFoundError):
            status = os.stat(self.path)
            return status.st_ino, status.st_mtime_ns
        return None

    def _read(self) -> _Turn:
        if not os.path.exists(self.path):
            raise ResumeError(self.path, "there is no such file")
        described, state = read(self.path)
        try:
            if described["class"] != _KIND:
                raise ValueError(f"it holds a {described['class']}")
            learned, target, seen = (check_kind(k, state[k], dict) for k in ("learned", "target", "seen"))
            actuators = [check_kind("actuators", name, str) for name in state["actuators"]]
            (a,) = as_tensors(a=seen["a"])
            check_shape("a", a, (len(actuators),))
            check_finite("a", a)
            goal = PoseTarget(target["position"], target["rotation"])
            pose = PoseTarget(seen["position"], seen["rotation"]) if seen["seen"] else None
            motions = check_count("motions", state["motions"], 0)
            reason = check_kind("reason", state["reason"], str)
            return _Turn(learned, goal, actuators, a, pose, motions, reason)
        except Exception as error:  # of another version, or of something else
            problem = f"no journal of a turn ({error}): name another file"
            raise FileFormatError(self.path, problem) from None
