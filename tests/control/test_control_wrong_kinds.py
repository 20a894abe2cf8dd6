"""What a loop calls answers a wrong kind with the package's error, and nothing has changed."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from light_plant import Obedient

from torch_ekm.control import ClosedLoop, HandKnowledge, LookAndMoveController, PoseTarget
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import EKMError
from torch_ekm.plant import Path, ServoInverse
from torch_ekm.residual import RecursiveLeastSquares, SparseOnlineGP, default_learner

WRONG = [
    None, "text", [], {}, ["a"], object(), 3, float("nan"), np.array(["a"]), torch.nn.Linear(2, 2), int,
    torch.zeros(2, dtype=torch.complex64),
]  # fmt: skip

Door = tuple[Callable[..., Any], list[Any]]


@pytest.fixture(scope="module")
def doors(held) -> dict[str, Door]:
    """What a loop calls, with arguments that are right."""
    seen, axis, model = held
    state, known = seen.state, HandKnowledge.of(model.hand)
    ekm, lin = EnhancedModel.for_grasp(model, state), model.linearize(state)
    controller, target = LookAndMoveController(ekm, axis), PoseTarget.turned(state, axis, degrees=5)
    still, moved = torch.zeros(9, dtype=torch.float64), torch.zeros(state.n_s, dtype=torch.float64)
    f = torch.zeros(5, dtype=torch.float64)
    plant = Obedient(model, seen)
    inverse = ServoInverse(plant, model.hand)
    loop = ClosedLoop(plant, controller)
    found: dict[str, Door] = {
        "model": (model, [state, still]),
        "model.linearize": (model.linearize, [state]),
        "model.contacts": (model.contacts, [state]),
        "lin.step": (lin.step, [still]),
        "kinematics": (model.kinematics, [state.q]),
        "state.plus": (state.plus, [moved]),
        "state.minus": (state.minus, [state]),
        "target.error": (target.error, [state]),
        "ekm": (ekm, [state, still]),
        "ekm.predict": (ekm.predict, [state, still]),
        "ekm.linearize": (ekm.linearize, [state, still]),
        "ekm.update": (ekm.update, [state, still, moved]),
        "decide": (controller.decide, [state, seen.a, target]),
        "loop.plan": (loop.plan, [target]),
        "plant.command": (inverse.command, [still]),
        "plant.follow": (lambda wrong: inverse.follow(wrong, lambda seen: True), [Path(still[None], [1.0])]),
        "servo.update": (known.servo.update, [still, still]),
        "forces.update": (known.forces.update, [still, f, f, 0.1]),
        "figures.learn": (known.figures.learn, [lin, still, moved]),
    }
    for learner in (SparseOnlineGP(3, 2), default_learner(3, 2), RecursiveLeastSquares(3, 2)):
        kind, x = type(learner).__name__, torch.zeros(3)
        found |= {f"{kind}.{name}": (getattr(learner, name), [x]) for name in ("predict", "linearize")}
        found |= {kind: (learner, [x]), f"{kind}.update": (learner.update, [x, torch.zeros(2)])}
    return found


def test_a_wrong_kind_is_refused_at_every_door(doors, unchecked) -> None:
    for name, (call, arguments) in doors.items():
        call(*arguments)
        for place in range(len(arguments)):
            for wrong in WRONG:
                given = [*arguments[:place], wrong, *arguments[place + 1 :]]
                try:
                    with pytest.raises(EKMError):
                        call(*given)
                except Exception as error:
                    raise AssertionError(f"{name}, argument {place}: {wrong!r}") from error
