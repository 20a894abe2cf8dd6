from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...description import HandDescription, ObjectDescription, load_hand, load_object
from ...exceptions import DescriptionError, EKMError
from ...kinematics.se3 import log as rotation_vector
from ...plant import Trajectory, TrialLog
from ...rendering import Scene, make_scene
from ...typing import Array
from .words import as_html

_FRAME_SECONDS = 0.25


class LogShow:
    """One trial of a log, command by command: the truth where it is known, else what was estimated.

    Args:
        log: a folder with trials (see :class:`~torch_ekm.plant.TrialLog`) or one trial's file.
        trial: which to begin with; the first one by default.
        estimates: show what was estimated although the truth is known.

    Raises:
        DescriptionError: no such log or trial, a damaged or empty one, or one that does not name its
            hand and object.
        UnknownNameError: its hand or object is not on this machine; the message lists those that are.
    """

    def __init__(self, log: Path, trial: int | None = None, estimates: bool = False) -> None:
        self.path, self.estimates = log, estimates
        self.log = None if log.is_file() else TrialLog.open(log)
        self.trials = () if self.log is None else self.log.trials
        if self.log is None and trial is not None:
            raise DescriptionError(log, f"this is one trial's file; to choose trial {trial}, name its folder")
        self._bodies: tuple[HandDescription, ObjectDescription] | None = None
        self.open(trial if trial is not None or not self.trials else self.trials[0])

    @property
    def title(self) -> str:
        """The name of the log and the number of the trial."""
        return f"{self.path.name}, trial {self.trial}"

    def open(self, trial: int | None) -> None:
        """Show another trial, or with None the file itself, from its first observation.

        Raises:
            DescriptionError: it is damaged, empty, or does not name its hand and object.
        """
        trajectory = Trajectory.load(self.path) if self.log is None or trial is None else self.log.read(trial)
        source = self.path if self.log is None or trial is None else self.log.path(trial)
        if not trajectory.observations:
            reason = trajectory.about.get("outcome", {}).get("reason", "it holds no observation")
            raise DescriptionError(source, f"there is nothing to show: {reason}")
        configuration = trajectory.about.get("configuration", {})
        for name in ("hand", "object"):
            if not isinstance(configuration.get(name), str):
                raise DescriptionError(source, f"its configuration names no {name}, needed to draw it")
        if self._bodies is None:
            self._bodies = load_hand(configuration["hand"]), load_object(configuration["object"])
        gravity = configuration.get("gravity", self._bodies[0].gravity)
        self.trajectory, self._frame = trajectory, 0
        self.trial = trajectory.about.get("trial", trial)
        self._scene = self._drawn(trajectory, np.array(gravity, dtype=np.float64))

    def scene(self) -> Scene:
        """A frame for each observation of the trial, in the order of time, hand frame."""
        return self._scene

    def add_controls(self, gui: Any) -> None:
        """A list of trials, a slider for the command that is shown, and a box to let it play."""
        names = [str(trial) for trial in self.trials]
        self._choice = gui.add_dropdown("trial", names, initial_value=str(self.trial)) if names else None
        self._slider = gui.add_slider("command", min=0, max=max(1, self._last), step=1, initial_value=0)
        self._play = gui.add_checkbox("play", initial_value=True)
        self._note = gui.add_html(self._words(0))
        self._due = time.monotonic()

    def update(self) -> Array | None:
        """Where everything is now, ``(n_shapes, 4, 4)``; None if nothing has moved."""
        if self._choice is not None and int(self._choice.value) != self.trial:
            chosen = int(self._choice.value)
            try:
                self.open(chosen)
            except EKMError as error:  # a damaged trial among others
                self.trial, self._note.content = chosen, as_html([error])
                return None
            self._slider.max, self._slider.value = max(1, self._last), 0
            self._frame = -1
        if self._play.value and time.monotonic() >= self._due:
            self._due = time.monotonic() + _FRAME_SECONDS
            self._slider.value = 0 if self._slider.value >= self._last else self._slider.value + 1
        frame = min(int(self._slider.value), self._last)
        if frame == self._frame:
            return None
        self._frame, self._note.content = frame, self._words(frame)
        return self._scene.transforms[frame]

    @property
    def _last(self) -> int:
        return len(self.trajectory.observations) - 1

    def _drawn(self, trajectory: Trajectory, gravity: Array) -> Scene:
        assert self._bodies is not None
        hand, obj = self._bodies
        states = []
        for seen in trajectory.observations:
            state = seen.state if self.estimates or seen.truth is None else seen.truth.state
            states.append([state.q, state.position, state.rotation])
        q, position, rotation = (torch.stack(part).numpy() for part in zip(*states, strict=True))
        if q.shape[-1] != hand.n_q:
            problem = f"has {q.shape[-1]} joints, the hand '{hand.name}' {hand.n_q}: it was of another hand"
            raise DescriptionError(self.path, problem)
        return make_scene(hand, obj, q, position, rotation, gravity)

    def _words(self, frame: int) -> str:
        """What is known of one moment."""
        first, seen = self.trajectory.observations[0], self.trajectory.observations[frame]
        turned = math.degrees(float(rotation_vector(seen.rotation @ first.rotation.mT).norm()))
        lines = [f"{seen.time:.2f} s, {seen.status.value}, turned by {turned:.1f} deg"]
        if seen.truth is not None:
            wrong = math.degrees(float(rotation_vector(seen.rotation @ seen.truth.rotation.mT).norm()))
            lines.append(f"measured rotation wrong by {wrong:.2f} deg")
        if frame:
            moved = self.trajectory.commands[frame - 1].rad2deg().tolist()
            names = self._bodies[0].actuator_names if self._bodies else ()
            motion = [f"{n} {v:+.1f}" for n, v in zip(names, moved, strict=False) if abs(v) >= 0.05]
            lines.append("commanded [deg]: " + (", ".join(motion) or "nothing"))
        lines += [f"event: {event}" for event in seen.info.get("events", ())]
        if frame == self._last and (reason := self.trajectory.about.get("outcome", {}).get("reason")):
            lines.append(f"ended: {reason}")
        return as_html(lines)
