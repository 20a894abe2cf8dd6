"""Both ways between learners and other libraries: river, scikit-learn, CapyMOA, CasADi, acados, GPyTorch.

Learners of this package in their interfaces, and theirs as a :class:`~torch_ekm.ResidualLearner` (extra
``peers``). Each imports its library when it is called, and names the extra if that is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..residual import ResidualLearner
from .acados_residual import AcadosResidual
from .capymoa_regressor import CapyMOARegressor
from .gpytorch_svgp import GPyTorchSVGP
from .gpytorch_window import GPyTorchWindow
from .online_regressor import LearnerLike, OnlineRegressor
from .river_residual import RiverResidual

if TYPE_CHECKING:
    from ..plant import TrialLog
    from .bags import BagTable
    from .casadi_residual import CasadiResidual
    from .river_regressor import RiverMultiTargetRegressor, RiverRegressor
    from .sklearn_regressor import SklearnRegressor


def as_river(learner: LearnerLike = None, targets: int = 1) -> RiverRegressor | RiverMultiTargetRegressor:
    """``y = c + g(x)`` as a regressor of river; a multi-target one if there is more than one output.

    Args:
        learner: untrained; or ``factory(in_features, out_features)``; None: the default.
        targets: how many outputs, where a factory has to know.

    Raises:
        MissingExtraError: river is not installed.
    """
    from .river_regressor import RiverMultiTargetRegressor, RiverRegressor

    if isinstance(learner, ResidualLearner):
        targets = learner.out_features
    return RiverRegressor(learner) if targets == 1 else RiverMultiTargetRegressor(learner)


def as_sklearn(learner: LearnerLike = None) -> SklearnRegressor:
    """``y = c + g(X)`` as a regressor of scikit-learn with ``partial_fit``.

    Args:
        learner: ``factory(in_features, out_features)``, or untrained and of the right sizes; None: the
            default.

    Raises:
        MissingExtraError: scikit-learn is not installed.
    """
    from .sklearn_regressor import SklearnRegressor

    return SklearnRegressor(learner)


def as_capymoa(schema: Any = None, learner: LearnerLike = None) -> CapyMOARegressor:
    """``y = c + g(x)`` as a regressor of CapyMOA, which needs not be importable.

    Args:
        schema: ``stream.get_schema()``.
        learner: as in :func:`as_sklearn`.
    """
    return CapyMOARegressor(schema, learner)


def to_casadi(learner: ResidualLearner, *, variance: bool = True) -> CasadiResidual:
    """``g(x; p)`` as a CasADi function; p is all that learning changes, so an optimiser is built once.

    Args:
        learner: a SparseOnlineGP or a MixtureResidual of such.
        variance: with the variance and its derivative; without, p is much shorter.

    Raises:
        MissingExtraError: CasADi is not installed.
        ParameterError: a learner, kernel or units of another kind.
    """
    from .casadi_residual import CasadiResidual

    return CasadiResidual(learner, variance=variance)


def read_bag(path: str | Path, clock: str, topics: Sequence[str] = ()) -> BagTable:
    """A recording of ROS (MCAP, sqlite3 or .bag) as a table: a row for each message of ``clock``.

    Other topics keep their last message: nothing of the future enters a row. Rows before every topic had its
    first message are left out, and so are texts, headers and fields of more than 64 numbers.

    Args:
        path: a folder of rosbag2, a single ``.mcap`` or ``.db3`` file, or a ``.bag`` of ROS 1.
        clock: the topic that sets the rhythm, such as that of the commands.
        topics: those that are read; all of them by default.

    Returns:
        ``names`` (``/topic.field.joint`` or ``/topic.field[0]``), ``time`` ``(n,)`` [s] from the first row,
        ``values`` ``(n, columns)`` in the messages' own units.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        DescriptionError: there is no such recording, it cannot be read, or no row is complete.
        UnknownNameError: there is no such topic; the message lists them.
    """
    from . import bags

    return bags.read_bag(path, clock, topics)


def log_to_mcap(log: TrialLog, folder: str | Path) -> list[Path]:
    """Every trial of a log as a rosbag2 recording in MCAP, one folder each; returns the folders.

    A topic for each array, a message for each observation at its time: ``/q``, ``/a`` and ``/commands``
    (increments [rad], at the time of the observation before them) as JointState, ``/object_pose`` as
    PoseStamped in the frame ``hand``, all others as multi-arrays; ``/about`` says the rest.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        ParameterError: one of the recordings exists already.
    """
    from . import mcap_log

    return mcap_log.log_to_mcap(log, folder)


def log_from_mcap(folder: str | Path, target: str | Path) -> TrialLog:
    """The log again, in ``target``, with the same figures.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
        DescriptionError: there is no recording of torch_ekm, or one cannot be read.
        ParameterError: a trial is in the target already.
    """
    from . import mcap_log

    return mcap_log.log_from_mcap(folder, target)


__all__ = [
    "AcadosResidual",
    "CapyMOARegressor",
    "GPyTorchSVGP",
    "GPyTorchWindow",
    "LearnerLike",
    "OnlineRegressor",
    "RiverResidual",
    "as_capymoa",
    "as_river",
    "as_sklearn",
    "log_from_mcap",
    "log_to_mcap",
    "read_bag",
    "to_casadi",
]
