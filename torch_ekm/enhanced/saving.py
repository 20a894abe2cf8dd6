"""``save`` and ``load``: a learner, or an enhanced model with its encoding, in one file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import Any

from torch import nn

from .._recorded import describe
from ..exceptions import FileFormatError, NoStateError, ParameterError
from ..kinematics.poses import GraspState
from ..residual.base import ResidualLearner
from ..residual.files import known_classes, read, rebuild, write
from .enhanced_model import EnhancedModel


def save(learner: ResidualLearner | EnhancedModel, path: str | os.PathLike) -> None:
    """Write how a learner was made and all that it has learned; of an enhanced model everything but f.

    The file is a zip archive of a JSON header and arrays. It appears whole or not at all.

    Raises:
        NoStateError: it holds something that is not a plain value, such as a function for ``encode`` (save
            its ``learner``) or another library's objects; the message names it.
        OutputError: the file cannot be written.
    """
    if isinstance(learner, EnhancedModel):
        described = describe(learner)
        described["arguments"].pop("model")
        state = {name: one for name, one in learner.state_dict().items() if not name.startswith("model.")}
    elif isinstance(learner, ResidualLearner):
        described, state = describe(learner), learner.state_dict()
    else:
        raise NoStateError(type(learner).__name__, "it is neither a ResidualLearner nor an EnhancedModel")
    write(path, described, state)


def load(
    path: str | os.PathLike, *, model: Callable[[Any, Any], Any] | None = None, classes: Iterable[type] = ()
) -> Any:
    """What :func:`save` wrote, made again and in the state it had. Nothing in the file is ever run.

    Args:
        model: f, if an enhanced model was saved.
        classes: learners, kernels or parts of your own that occur in the file.

    Returns:
        The ResidualLearner or EnhancedModel.

    Raises:
        FileFormatError: there is no such file, :func:`save` has not written it, or it is damaged.
        StateMismatchError: state and description do not go together.
        ParameterError: a class is not known, or f is missing (or given for a learner).
    """
    described, state = read(path)
    known = known_classes(classes) | {"GraspState": GraspState}
    enhanced = isinstance(described, dict) and described.get("class") == "EnhancedModel"
    if enhanced != (model is not None):
        valid = "None: the file holds a learner alone"
        if enhanced:
            valid = "the model f, as in load(path, model=f): the file holds f + g without f"
        raise ParameterError("model", model, valid)
    if model is not None:
        known["EnhancedModel"] = lambda **arguments: EnhancedModel(model, **arguments)
        if isinstance(model, nn.Module):
            state |= {f"model.{name}": one for name, one in model.state_dict().items()}
    made = rebuild(path, described, state, known)
    if not isinstance(made, ResidualLearner | EnhancedModel):
        raise FileFormatError(path, f"holds a {type(made).__name__}, no learner")
    return made
