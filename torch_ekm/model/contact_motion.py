"""Motions of a grasp whose contacts stick, slide, open and close."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
import torch

from .._arrays import in_torch, of_fields
from ..contact.detector import ContactDetector
from ..exceptions import GraspEndsError, GraspError, NoContactError
from ..kinematics.poses import GraspState
from ..kinematics.se3 import exp
from ..typing import Array, Float, Tensor
from .contact_laws import Response, StepSolution, solve
from .linearization import Linearization
from .step_program import (
    ContactLoads,
    GraspModel,
    HandLaws,
    L,
    PlacedGrasp,
    StepProgram,
    Way,
    mode_linearization,
)

NEAR = 0.004
"""Gap [m] up to which a pad or a link may close in a motion."""
_FINE = 2e-3  # [rad] a correction this small is the last: what is left is its square
_CLOSE = 3e-4  # [rad] after one this small the next motion begins with the matrices that are there
_SAME = 1e-6  # [rad] or this small, whatever the contacts do
_CORRECTIONS = 8
_LARGEST = 0.1  # [rad] of an actuator in one substep
_SMALLEST = 1 / 64  # share of a motion
_DAMPING = 0.5  # [N m/rad] of a fall to the next equilibrium
_FALLS = 60  # steps of a fall
_CALM = 1e-3  # [rad] a step of a fall this small has come to rest
_FARTHEST = 0.3  # [rad] of a substep, beyond which Newton's method has left for elsewhere, and of a fall
_LEAP = 0.1  # [rad] of the object in a substep: friction allows several equilibria, and this is another


class ContactMode(Enum):
    """What a contact does at the end of a motion."""

    STICK = "stick"
    """It sticks or rolls."""
    SLIDE = "slide"
    OPEN = "open"


@dataclass(frozen=True)
class ContactStep:
    """One motion, and what the contacts did in it; pads by name, links without a pad by the link's name."""

    state: GraspState
    """After it."""
    increment: Float[Tensor, " n_s"]
    """``[dq; do; dphi]`` [rad, m, rad]."""
    normal: dict[str, float]
    """f_n after it [N]."""
    modes: dict[str, ContactMode]
    jacobian: Float[Tensor, "n_s n_a"]
    """``d increment/d da`` of the last substep, contacts doing what they do at its end."""


class _Solved(NamedTuple):
    names: tuple[str, ...]
    """Of the contacts of the program."""
    program: StepProgram
    answer: StepSolution
    loads: ContactLoads
    state: GraspState

    @property
    def doing(self) -> tuple[object, ...]:
        """What the contacts do."""
        return self.names, self.answer.active.tolist(), self.answer.slides.tolist()


class _Start(NamedTuple):
    grasp: PlacedGrasp
    loads: ContactLoads
    """There."""
    z: Array
    """From the present state to it."""


class _Substep(NamedTuple):
    last: _Solved
    rates: Response
    """By da."""


class ContactMotion:
    """``V_s + A^T mu + B^T lam = load`` after every motion, under one-sided contacts, stops and tendons, and
    Coulomb friction.

    ```
    gap_i >= 0,  f_n,i >= 0,  gap_i f_n,i = 0                  every pad, and every link within 4 mm
    |f_t,i| <= mu_s f_n,i,  along the slide where it slides    slide: mean of both ends, times ds
    p_j = K_a (a - a_0 - J_a q),  p_j >= 0 of tendons
    q_min <= q <= q_max
    ```

    The equilibrium of the end is found by Newton's method on the state: contacts are detected, and the
    stiffness is taken, at the end itself. A motion is divided where that does not converge. Where there is no
    equilibrium near, the grasp falls, damped, to the next one.

    Two forms. Without ``a`` the present reading is an equilibrium under the forces of ``start``: what they
    leave unbalanced is a constant load, and the gaps of contacts that bear count from where they are. With
    ``a`` nothing is remembered: encoders and joints give the forces of compliant actuators, gaps are those of
    the detector. The first is for a hand that is not quite as described, the second for one that is.

    A model that follows figures of the hand moves with those that are known when the motion begins.

    With a detector of one's own only what it reports can touch.

    Args:
        model: of hand and object.
        start: the model linearized where the motion begins, with the forces there, best with the contacts of
            :meth:`KinematicModel.touching`.
        a: encoders there [rad].
    """

    state: GraspState
    """Where the grasp is now."""
    loads: ContactLoads
    """Forces there."""

    def __init__(
        self, model: GraspModel, start: Linearization, *, a: Float[Tensor, " n_a"] | None = None
    ) -> None:
        self.model, self.state = model, start.state
        drives = model.reduction.drives
        self._springs = np.zeros(model.hand.n_q)
        figures, equations = model.figures, start.equations
        if figures is not None and equations is not None and figures.solve(equations) is not None:
            springs, drives = figures.present(drives)
            self._springs = springs.detach().double().numpy()
        self._laws = laws = HandLaws(model, drives)
        self._placed: PlacedGrasp | None = None
        self._near: _Start | None = None
        self.loads = _loads(start)
        if a is not None:
            stretch = a.numpy() - model.hand.actuator_offset - laws.length(start.state.q.numpy())
            self.loads.pull[laws.soft] = laws.K[laws.soft] * stretch[laws.soft]
        self._zero: dict[str, float] = {}
        self._count_gaps(absolute=a is not None)
        still = np.zeros(laws.S.shape[1])
        self._load = still if a is not None else laws.unbalance(self._grasp, self.loads)
        self._is_settled = True

    def __copy__(self) -> ContactMotion:
        made = object.__new__(ContactMotion)
        made.__dict__.update(self.__dict__, _zero=dict(self._zero))  # all else is replaced, never changed
        return made

    @property
    def _grasp(self) -> PlacedGrasp:
        """Contacts and matrices at the present state, found when they are first asked for."""
        if self._placed is None:
            self._placed = self._place(self.state)
        return self._placed

    @property
    def _start(self) -> _Start:
        """Where the next motion is linearized first: here, or close by where the last correction was."""
        if self._placed is None and self._near is not None:
            return self._near
        return _Start(self._grasp, self.loads, np.zeros(self._laws.S.shape[1]))

    def _stand(
        self, state: GraspState, placed: PlacedGrasp | None, loads: ContactLoads, near: _Start | None = None
    ) -> None:
        self.state, self._placed, self.loads, self._near = state, placed, loads, near

    def move(self, delta_a: Float[Tensor, " n_a"]) -> ContactStep:
        """The state after the encoders moved by ``delta_a`` [rad]; the next motion begins there.

        Raises:
            NoContactError: nothing touches the object any more.
            GraspEndsError: no equilibrium is found: the object slips away. The motion stands where it began.
        """
        self._settle()
        start = self._start
        before, names = (self.state, self._placed, self.loads, self._near), start.grasp.contacts.finger
        way = delta_a.detach().double().numpy()
        share = 1 / max(1, math.ceil(float(np.abs(way).max(initial=0.0)) / _LARGEST))
        done = 0.0
        while True:
            share = min(share, 1 - done)
            found = self._substep(share * way)
            if found is None and share / 2 >= _SMALLEST:
                share /= 2
                continue
            found = found or self._fall(share * way)
            if found is None:
                ends = self._why()
                self._stand(*before)
                raise ends
            done += share
            if done > 1 - 1e-9:
                return self._report(before[0], names, found)

    def linearize(self, delta_a: Float[Tensor, " n_a"]) -> Linearization:
        """``d increment/d da`` here, in the mode that a motion by ``delta_a`` [rad] brings: contacts stick,
        slide and open as they do at its end, to first order.

        The contacts of the answer are those that bear, links included. The increment is ``J_m da`` where they
        do the same all the way.

        Raises:
            NoContactError: nothing bears.
            GraspEndsError: no equilibrium is near.
        """
        self._settle()
        grasp, loads, still = self._grasp, self.loads, np.zeros(self._laws.S.shape[1])
        done = self._solve(grasp, loads, Way(grasp, loads.pull, delta_a.detach().double().numpy(), still))
        if done is None:
            raise self._why()
        return mode_linearization(self._laws, grasp, loads, done.program, done.answer)

    def answered(self, lin: Linearization) -> Linearization:
        """A linearization of this state with ``df_n/da`` by the figures that are known, as motions have them:
        alone it has the description's."""
        if lin.described is None:
            return lin
        try:
            mine = self.linearize(torch.zeros(self.model.hand.n_a, dtype=lin.forces.normal.dtype))
        except GraspError:
            return lin
        normal, rows = lin.normal_force_sensitivity.clone(), mine.contacts.finger
        for i, name in enumerate(lin.contacts.finger):
            if name in rows:
                normal[i] = mine.normal_force_sensitivity[rows.index(name)]
        return dataclasses.replace(lin.with_normal_sensitivity(normal), described_normal=None)

    def shift(self, increment: Float[Tensor, " n_s"]) -> None:
        """Go on from ``s (+) increment`` [rad, m, rad] as from a reading: the forces are those of now, which
        a constant load balances, and the gaps of contacts that bear count from where they are. Joints follow
        by the least motion that lets no contact that bears open or slide."""
        follow = self._grasp.follow(increment.numpy(), self.loads)
        self._stand(self.state.plus(increment + torch.from_numpy(follow)), None, self.loads)
        self._is_settled = False

    def _settle(self) -> None:
        """After a shift, once a motion begins here: gaps and the load that balances the forces."""
        if not self._is_settled:
            self._count_gaps(absolute=False)
            self._load, self._is_settled = self._laws.unbalance(self._grasp, self.loads), True

    def _count_gaps(self, *, absolute: bool) -> None:
        """From where gaps are counted [m]: one that overlaps, or bears in the incremental form, is closed."""
        lam, _ = self._grasp.components(self.loads)
        contacts = self._grasp.contacts
        for name, gap, bears in zip(contacts.finger, contacts.gap.tolist(), lam > 0, strict=True):
            self._zero[name] = gap if bears and not absolute else min(gap, 0.0)

    def _substep(self, da: Array) -> _Substep | None:
        """Newton on the state: equilibrium, gaps and cones of the end. None: no convergence."""
        (here, loads, total), was = self._start, None
        way = Way(here, self.loads.pull, da, total)
        for correction in range(_CORRECTIONS):
            done = self._solve(here, loads, way)
            if done is None or (self._farthest(way.total + done.answer.z) > (_FARTHEST, _LEAP)).any():
                return None
            size, doing = float(np.abs(done.answer.z).max()), done.doing
            if correction and (size < _SAME or (size < _FINE and doing == was)):
                near = _Start(here, loads, -done.answer.z) if size < _CLOSE else None
                self._stand(done.state, None, done.loads, near)
                rates = self._laws.response(here, done.program.problem, done.answer)
                return _Substep(done, rates)
            loads, here, was = done.loads, self._place(done.state), doing
            way = way._replace(total=way.total + done.answer.z)
        return None

    def _fall(self, da: Array) -> _Substep | None:
        """A motion after which no equilibrium is near: the grasp moves on, damped, until it finds one.
        None: it finds none."""
        fallen = still = np.zeros(self._laws.S.shape[1])
        for _ in range(_FALLS):
            way = Way(self._grasp, self.loads.pull, da, still)
            done = self._solve(self._grasp, self.loads, way, _DAMPING)
            if done is None or self._farthest(fallen := fallen + done.answer.z).max() > _FARTHEST:
                return None
            self._stand(done.state, None, done.loads)
            da = np.zeros(len(da))
            rest = self._substep(da) if float(np.abs(done.answer.z).max()) < _CALM else None
            if rest is not None:
                return rest
        return None

    def _solve(
        self, here: PlacedGrasp, loads: ContactLoads, way: Way, damping: float = 0.0
    ) -> _Solved | None:
        """One program, and what it makes of forces and state."""
        contacts = here.contacts
        if not contacts.n_c:
            return None
        gap = [
            gap - self._zero.setdefault(name, min(gap, 0.0))
            for name, gap in zip(contacts.finger, contacts.gap.tolist(), strict=True)
        ]
        program = self._laws.program(here, loads, way, np.array(gap), self._load, damping)
        answer = solve(program.problem, program.lam, program.t)
        if answer is None:
            return None
        after = self._laws.loads(here, program, answer, way)
        state = _moved(here.state, self._laws.S @ answer.z)
        return _Solved(contacts.finger, program, answer, after, state)

    def _farthest(self, z: Array) -> Array:
        """Largest entries of an increment: of the joints, and of the object, translations in units of L."""
        joints = self._laws.joints
        n_y = joints.shape[1]
        return np.array([np.abs(joints @ z[:n_y]).max(), np.abs(z[n_y:]).max()])

    def _report(self, before: GraspState, names: tuple[str, ...], last: _Substep) -> ContactStep:
        """Of a whole motion; ``names``: contacts that were near when it began."""
        answer = last.last.answer
        modes = dict.fromkeys((*names, *last.last.names), ContactMode.OPEN)
        normal = dict.fromkeys(modes, 0.0)
        for i, name in enumerate(last.last.names):
            normal[name] = float(answer.lam[i]) / L
            if answer.active[i]:
                modes[name] = ContactMode.SLIDE if answer.slides[i] else ContactMode.STICK
        if all(mode is ContactMode.OPEN for mode in modes.values()):
            raise NoContactError("no finger touches the object after this motion")
        return ContactStep(
            state=self.state,
            increment=self.state.minus(before),
            normal=normal,
            modes=modes,
            jacobian=torch.from_numpy(self._laws.S @ last.rates.z),
        )

    def _place(self, state: GraspState) -> PlacedGrasp:
        model, detector = self.model, self.model.touch_detector
        poses = model.kinematics(state.q)
        if isinstance(detector, ContactDetector):
            contacts = detector.near(poses, state.position, state.rotation, NEAR, self.loads.force)
        else:
            contacts = detector(state.q, state.position, state.rotation)
        return PlacedGrasp(model, state, contacts, poses, self._springs)

    def _why(self) -> GraspEndsError:
        """What ends the grasp, as it stands now."""
        lam, t = self._grasp.components(self.loads)
        full = (np.linalg.norm(t, axis=1) >= 0.95 * self._grasp.mu_s * lam) & (lam > 0)
        at = [name for name, used in zip(self._grasp.contacts.finger, full, strict=True) if used]
        why = f"{' and '.join(at)} at the friction limit: " if at else ""
        return GraspEndsError(f"{why}no equilibrium is near after this motion; the object slips away")


def _moved(state: GraspState, ds: Array) -> GraspState:
    """``s (+) ds`` of finite numbers, not checked again."""
    q, position = state.q.numpy() + ds[:-6], state.position.numpy() + ds[-6:-3]
    rotation = exp(ds[-3:]) @ state.rotation.numpy()
    return in_torch(of_fields(GraspState, q=q, position=position, rotation=rotation))


def _loads(lin: Linearization) -> ContactLoads:
    forces = lin.forces
    found = forces.force, -forces.lam, forces.stop_torque, forces.loop
    force, pull, stop, loop = (x.detach().double().numpy() for x in found)
    return ContactLoads(
        dict(zip(lin.contacts.finger, force, strict=True)),
        dict(zip(lin.contacts.finger, forces.spin_moment.tolist(), strict=True)),
        pull.copy(),
        stop.copy(),
        loop,
    )
