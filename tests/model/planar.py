"""The packaged planar hand, two fingers and two tendons, holding a block in exact equilibrium."""

from __future__ import annotations

from functools import lru_cache

import torch
from equilibrium import EquilibriumSolver
from test_model_planar_hand import pinch

F64 = torch.float64


@lru_cache(maxsize=1)
def planar():
    """Model, encoders, and the model linearized where it stands."""
    model, state, contacts = pinch()
    solver = EquilibriumSolver(model, state, contacts)
    at = solver.find(torch.full((2,), 1.2, dtype=F64))
    contacts = at.contacts.replace(finger=tuple(pad.name for pad in model.hand.pads))
    model.detector = lambda *_: contacts
    lin = model.linearize(at.state, contacts, forces=solver.forces(at))
    return model, solver.actuators(at.state), lin
