"""Exact recordings of a toy hand: three fingers, compliant tendons, balls on planes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import torch
from model_toys import three_finger

from torch_ekm.description import ContactPad
from torch_ekm.kinematics import Play
from torch_ekm.model import KinematicModel

F64 = torch.float64


class Toy:
    """The true hand, exact recordings of it, and models of hands with other figures."""

    def __init__(self, stiffness: float = 2e4) -> None:
        toy = three_finger(stiffness=stiffness)
        pads = tuple(
            ContactPad(name, link, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.008)
            for name, link in zip(toy.contacts.finger, toy.contacts.link, strict=True)
        )
        self.hand = dataclasses.replace(toy.model.hand, pads=pads)
        self.solver, self.at = toy.solver(), toy.equilibrium()
        self.toy = toy

    def model(self, hand) -> KinematicModel:
        """Contacts are exact functions of the state."""
        old = self.toy.model
        detector = lambda q, o, R: self.solver.surfaces(q, o, R)  # noqa: E731
        return KinematicModel(hand, old.obj, old.options, kinematics=old.kinematics, detector=detector)

    def recordings(self, steps=12, size=2e-4, play=None, force=True, seed=0):
        """Random positions of the tendons around the start [m]; encoders are before the play."""
        draw = np.random.default_rng(seed)
        at, observations = self.at, []
        motor = at.a.clone()
        play = Play(torch.zeros(3, dtype=F64)) if play is None else play
        state = play.at(torch.zeros(3, dtype=F64))
        for k in range(steps + 1):
            if k:
                goal = self.at.a + torch.from_numpy(draw.uniform(-size, size, 3)) / self.toy.unit
                moved, state = play.advance(state, goal - motor)
                motor, at = goal, self.solver.moved(at, at.a + moved)
            normal = self.solver.forces(at).normal if force else None
            s = at.state
            seen = {"q": s.q, "position": s.position, "rotation": s.rotation, "a": motor}
            observations.append(SimpleNamespace(**seen, fingertip_force=normal, status="held"))
        return [SimpleNamespace(observations=observations)]

    def wrong(self, seed=0):
        """Springs, arms and stiffnesses each off by 10 to 30 %."""
        draw = np.random.default_rng(seed)

        def factor(*shape):
            return 1 + draw.uniform(0.1, 0.3, shape) * draw.choice([-1, 1], shape)

        hand = self.hand
        actuators = tuple(
            dataclasses.replace(actuator, stiffness=actuator.stiffness * float(factor()))
            for actuator in hand.actuators
        )
        return dataclasses.replace(
            hand,
            actuators=actuators,
            actuation_jacobian=hand.actuation_jacobian * factor(*hand.actuation_jacobian.shape),
            spring_stiffness=hand.spring_stiffness * factor(hand.n_q),
        )
