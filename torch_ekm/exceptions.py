"""Every error that torch_ekm raises on purpose.

One root, :class:`EKMError`, so that a control loop can catch all of them in one
clause. Each child carries the offending data as attributes, lists the valid
choices where there are any, and says in its message what would be right.

That clause holds for what a loop calls with samples, readings, states and targets:
learners and models (``update``, ``forward``, ``predict``, ``linearize``), a state's ``plus``
and ``minus``, a target's ``error``, ``decide``, ``run``, ``steps``, ``plan``,
a plant's ``command`` and ``follow``, and ``update`` and ``learn`` of what is known of a hand. There
a text or None in place of a tensor, a state or a target is a :class:`ParameterError`, too, and
nothing was changed. Constructors, and functions that take what came through one of these doors,
answer a wrong kind as Python does.
"""

from __future__ import annotations

import copyreg
from collections.abc import Iterable
from typing import Any

__all__ = [
    "BusError", "CalibrationError", "CommandRefusedError", "DescriptionError", "DeviceError", "EKMError",
    "EquilibriumError", "FileFormatError", "FolderInUseError", "GraspEndsError", "GraspError",
    "JointMismatchError", "MissingExtraError", "NeverAtRestError", "NoContactError", "NoDerivativeError",
    "NoStateError", "NonFiniteError", "ObjectLostError", "OutputError", "ParameterError",
    "PenetrationError", "PlacedError", "PlantInUseError", "ResumeError", "ShapeError", "SingularGraspError",
    "SolverError", "SpeedWarning", "StaleReadingError", "StateError", "StateMismatchError",
    "UnknownNameError", "UnstableGraspError", "WorkerDiedError",
]  # fmt: skip

_LONGEST = 2000  # characters of a message
_LONGEST_VALUE = 300  # of a value in one


class EKMError(Exception):
    """Root of all errors raised by torch_ekm. They survive pickling, to cross process boundaries whole."""

    def __reduce__(self) -> tuple[Any, ...]:
        # without the constructor, whose arguments are not kept
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class SpeedWarning(UserWarning):
    """Compiled loops are off, or not there yet: results are the same to rounding, and take longer."""


class PlacedError(EKMError):
    """Something is wrong at some place: a file, a sensor, a device.

    Attributes:
        where: file with line, sensor, port, topic or motor.
        problem: what is wrong with it, and what to do.
    """

    says = "{where}: {problem}"

    def __init__(self, where: object, problem: object) -> None:
        self.where, self.problem = str(where), str(problem)
        if len(self.problem) > _LONGEST:  # of a file that holds a name of a million letters
            self.problem = f"{self.problem[:_LONGEST]}..."
        super().__init__(self.says.format(where=where, problem=self.problem))


# -- what the user asked for does not exist -----------------------------------------------


class MissingExtraError(EKMError, ImportError):
    """An optional dependency is not installed.

    Attributes:
        module: the module that could not be imported.
        extra: the extra of torch_ekm that brings it.
    """

    def __init__(self, module: str, extra: str) -> None:
        self.module, self.extra = module, extra
        super().__init__(
            f"this part of torch_ekm needs the package '{module}', which is not installed; "
            f"it comes with the extra '{extra}': pip install 'torch_ekm[{extra}]'"
        )


class UnknownNameError(EKMError, KeyError):
    """A name is not in the list of valid ones, which the message gives.

    Attributes:
        kind: what was looked up ("hand", "object", "link", ...).
        name: the name that was not found.
        valid: the names that would have been right.
    """

    def __init__(self, kind: str, name: str, valid: Iterable[str]) -> None:
        self.kind, self.name, self.valid = kind, name, tuple(valid)
        listed = ", ".join(f'"{one}"' if "," in one else one for one in self.valid)
        super().__init__(f"unknown {kind} '{name}'; valid are: {listed or '(none)'}")

    def __str__(self) -> str:  # KeyError prints the repr of its argument
        return str(self.args[0])


# -- a description of a hand or object is wrong -------------------------------------------


class DescriptionError(PlacedError, ValueError):
    """A URDF or transmission file cannot be used; the message names the file and the place."""


class JointMismatchError(DescriptionError):
    """Joints named in one place are not those of the other.

    Attributes:
        missing: joints that the URDF has and that are needed here.
        unexpected: joints named here that the URDF lacks.
    """

    def __init__(
        self, source: object, missing: Iterable[str], unexpected: Iterable[str], valid: Iterable[str]
    ) -> None:
        self.missing, self.unexpected = tuple(missing), tuple(unexpected)
        self.valid = tuple(valid)
        parts = []
        if self.missing:
            parts.append(f"missing joints: {', '.join(self.missing)}")
        if self.unexpected:
            names = ", ".join(self.unexpected)
            parts.append(f"joints that do not turn, or that the URDF does not have: {names}")
        super().__init__(source, f"{'; '.join(parts)}; the URDF's joints are: {', '.join(self.valid)}")


# -- numbers that cannot be right -----------------------------------------------------------


class ShapeError(EKMError, ValueError):
    """A tensor has the wrong shape.

    Attributes:
        name: the argument.
        expected: the expected shape, in words or symbols.
        actual: the shape that came.
    """

    def __init__(self, name: str, expected: str, actual: Iterable[int], hint: str = "") -> None:
        self.name, self.expected, self.actual = name, expected, tuple(actual)
        super().__init__(
            f"{name} must have shape {expected}, got {self.actual}" + (f"; {hint}" if hint else "")
        )


class NonFiniteError(EKMError, ValueError):
    """A value is NaN or infinite, or its square is. Nothing was changed.

    Attributes:
        name: the argument.
        where: indices of the offending entries (the first few).
    """

    def __init__(self, name: str, where: Any = ()) -> None:
        self.name, self.where = name, where
        super().__init__(
            f"{name} must be finite, and its square too; not so at {list(where) if where else 'some entry'}; "
            "the call was refused and no state was changed"
        )


class ParameterError(EKMError, ValueError):
    """A parameter lies outside its valid range, which the message gives."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name, self.value, self.valid = name, value, valid
        shown = repr(value)
        if len(shown) > _LONGEST_VALUE:  # a large tensor, a whole module
            shown = f"{' '.join(shown.split())[:_LONGEST_VALUE]}..."
        super().__init__(f"{name} = {shown} is not valid; it must be {valid}")


class StateError(EKMError, RuntimeError):
    """Something is not as it must be for what is asked of it: not started, closed, empty, of another hand.

    The message says what it is, and what would be right.
    """


# -- the grasp cannot be modelled -----------------------------------------------------------


class GraspError(EKMError):
    """Root of the errors about a grasp."""


class NoContactError(GraspError):
    """Nothing touches the object, so there is no manipulation Jacobian."""


class PenetrationError(GraspError):
    """A finger lies deeper inside the object than a contact can explain.

    Attributes:
        finger: name of the contact pad.
        depth: how deep [m].
    """

    def __init__(self, finger: str, depth: float, limit: float) -> None:
        self.finger, self.depth = finger, depth
        super().__init__(
            f"'{finger}' lies {1e3 * depth:.1f} mm inside the object, more than {1e3 * limit:.1f} mm: "
            "the object's pose or the joint angles cannot be right"
        )


class SingularGraspError(GraspError):
    """Some motion meets no stiffness and no constraint, or a step is impossible.

    Attributes:
        direction: unit state increment ``(n_s,)`` along which the system is singular.
    """

    def __init__(self, message: str, direction: Any = None) -> None:
        self.direction = direction
        super().__init__(message)


class UnstableGraspError(GraspError):
    """The locked-actuator stiffness ``N^T D N`` is not positive: the grasp buckles.

    Attributes:
        stiffness: its smallest eigenvalue (scaled units).
        direction: unit state increment ``(n_s,)`` along which the grasp buckles.
    """

    def __init__(self, message: str, stiffness: float | None = None, direction: Any = None) -> None:
        self.stiffness, self.direction = stiffness, direction
        super().__init__(message)


class GraspEndsError(GraspError):
    """No equilibrium is near after a motion: the object slips away, or the grasp jumps to another one."""


class ObjectLostError(GraspError):
    """The object has left the hand (dropped, thrown, or not seen any more)."""


class NoDerivativeError(EKMError, TypeError):
    """A model f does not say how its prediction changes with the action."""

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"f gives no derivative by the action: {reason}; pass jacobian=<a function (state, action) -> "
            "matrix (n_s, n_a)>, or jacobian='finite-difference'"
        )


# -- states and files -----------------------------------------------------------------------


class StateMismatchError(EKMError, RuntimeError):
    """A state dict or a file is not one of this learner; nothing of it was taken over.

    Attributes:
        differences: what does not fit, one text each.
    """

    def __init__(self, differences: Iterable[str]) -> None:
        self.differences = tuple(differences)
        shown = "; ".join(self.differences[:5]) + ("; ..." if len(self.differences) > 5 else "")
        super().__init__(f"the state is not one of this learner, nothing was loaded: {shown}")


class NoStateError(EKMError, TypeError):
    """A learner cannot be saved as plain values."""

    def __init__(self, learner: str, reason: str) -> None:
        super().__init__(f"{learner} cannot be saved as plain values: {reason}")


class FileFormatError(PlacedError, ValueError):
    """A file cannot be read as what it should be."""


class OutputError(PlacedError):
    """A file cannot be written: the disk is full, or the folder may not be written to."""

    says = "{where} cannot be written: {problem}; name a folder that can be written to"


class ResumeError(PlacedError):
    """A turn that was cut short cannot be gone on with; the hand holds."""


class FolderInUseError(EKMError):
    """Another writer, a process whose number (pid) may be known, is at work in a folder that takes one at a
    time."""

    def __init__(self, folder: object, holder: int | None) -> None:
        by = "another process" if holder is None else f"process {holder}"
        super().__init__(
            f"{folder} is being written to by {by}; wait until it has ended, or name another folder"
        )


class WorkerDiedError(EKMError):
    """A process that ran jobs ended without a word."""

    def __init__(self) -> None:
        super().__init__(
            "a process of the run was killed; look for a lack of memory, or take fewer processes: what is "
            "finished is kept, and the same call goes on"
        )


# -- solvers and control --------------------------------------------------------------------


class SolverError(EKMError):
    """A numerical solver did not succeed.

    Attributes:
        solver: its name.
        status: what it said.
    """

    def __init__(self, solver: str, status: str, hint: str = "") -> None:
        self.solver, self.status = solver, status
        super().__init__(f"solver '{solver}' failed: {status}" + (f"; {hint}" if hint else ""))


class EquilibriumError(SolverError):
    """No quasi-static equilibrium was found (see ``status`` for how far the solver came)."""


# -- sensors ----------------------------------------------------------------------------------


class CalibrationError(PlacedError):
    """A sensor cannot be calibrated from these measurements."""

    says = "calibration of {where}: {problem}"


# -- devices ----------------------------------------------------------------------------------


class DeviceError(PlacedError):
    """Root of what a driver of a real hand raises; ``where`` is a port, a topic or a motor."""


class BusError(DeviceError):
    """A device does not answer, or not as its protocol says."""


class StaleReadingError(DeviceError):
    """A sensor has sent nothing new for too long."""


class NeverAtRestError(DeviceError):
    """A motion did not come to rest in time."""


class CommandRefusedError(DeviceError):
    """A command beyond the limits of the wiring, or of a :class:`~torch_ekm.plant.Gate`; nothing was sent.

    Attributes:
        by, asked, allowed: who asked for what, and what would have passed; empty where a driver refuses.
    """

    by = asked = allowed = ""

    @classmethod
    def by_gate(cls, device: object, by: str, asked: str, allowed: str) -> CommandRefusedError:
        """What a gate says of a command."""
        error = cls(device, f"{by} asked for {asked}; allowed are {allowed}; nothing was sent")
        error.by, error.asked, error.allowed = by, asked, allowed
        return error


class PlantInUseError(EKMError):
    """Another loop or thread commands this plant: one hand has one master."""

    def __init__(self, plant: str) -> None:
        super().__init__(
            f"this {plant} is commanded by another loop, or by this one in another thread; wait until that "
            "has ended, or close its generator of steps"
        )
