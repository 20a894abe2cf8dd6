"""What an engine does for the simulated hand: bodies, time and contacts."""

from __future__ import annotations

from typing import Protocol

from ...description import ObjectDescription
from ...typing import Array

ENGINES = {"sapien": "SAPIEN", "mujoco": "MuJoCo"}
"""The physics that there are, by name, and what they are called."""


class Scene(Protocol):
    """A fixed hand and one free object; hand frame = world frame, SI units.

    Physics only, nothing of transmissions, servos or sensors: each joint has one drive of a given stiffness,
    which is integrated implicitly and aims at a target that :meth:`step` is given. An engine makes one of the
    hand, whose URDF gives links, inertias and shapes, the object as it really is, the time step [s], and the
    stiffness of each contact [N/m]; 0: as rigid as the engine has it.

    Raises:
        MissingExtraError: the engine is not installed.
        DescriptionError: what stands in the hand's URDF cannot be simulated.
    """

    time_step: float

    @property
    def q(self) -> Array:
        """Joint angles in the hand's order ``(n_q,)`` [rad]."""
        ...

    @property
    def next_q(self) -> Array:
        """Joint angles after the next step, if they keep their speed ``(n_q,)`` [rad]."""
        ...

    @property
    def object_pose(self) -> tuple[Array, Array]:
        """The object frame in the hand frame: ``(3,)`` [m] and ``(3, 3)``, orthogonal to float64."""
        ...

    @property
    def object_speed(self) -> tuple[float, float]:
        """Linear [m/s] and angular speed [rad/s] of the object, norms."""
        ...

    def place(self, q: Array, position: Array, rotation: Array) -> None:
        """Put hand and object there, at rest."""

    def set_object(self, obj: ObjectDescription) -> None:
        """Mass, centre of mass and inertia; the shapes stay."""

    def set_friction(self, friction: float, opposed: float, links: set[str]) -> None:
        """Coefficients of the object's two sides, the second at ``links``, of the finger that opposes the
        others: the same ones at each call."""

    def set_link_weight(self, pulls: bool) -> None:
        """Whether gravity pulls at the links too; without, only at the object."""

    def set_drive_stiffness(self, stiffness: Array) -> None:
        """Of each joint's drive ``(n_q,)`` [N m/rad]."""

    def hold_object(self, held: bool) -> None:
        """Fix the object where it is, or let it go at rest."""

    def step(self, drive_targets: Array) -> None:
        """One time step with the joints' drives aimed at the targets ``(n_q,)`` [rad]."""

    def push(self, force: Array, torque: Array) -> None:
        """Push the object during the next step: [N] at its centre of mass and [N m], hand frame."""

    def touches(self) -> dict[str, float]:
        """Links that touch the object now, each with the sum of the sizes of its normal forces [N]."""
        ...

    def snapshot(self) -> bytes:
        """All that moves, for :meth:`restore`; restored runs are all alike."""
        ...

    def restore(self, state: bytes) -> None: ...
