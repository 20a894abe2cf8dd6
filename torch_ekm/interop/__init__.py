"""Both ways between learners and other libraries: river, CasADi, ROS, LeRobot.

Learners of this package in their interfaces, and theirs as a :class:`~torch_ekm.ResidualLearner` (extra
``peers``). What needs another library is imported when it is first asked for, by its name here; a missing
library is a MissingExtraError that names the extra.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .online_regressor import OnlineRegressor
from .river_residual import RiverResidual

if TYPE_CHECKING:
    from .bags import BagTable, read_bag
    from .casadi_residual import CasadiResidual as to_casadi  # noqa: N813
    from .lerobot_dataset import log_to_lerobot
    from .mcap_log import log_to_mcap
    from .river_regressor import RiverRegressor as as_river  # noqa: N813

_ASKED_FOR = {
    "BagTable": ("bags", "BagTable"),
    "as_river": ("river_regressor", "RiverRegressor"),
    "log_to_lerobot": ("lerobot_dataset", "log_to_lerobot"),
    "log_to_mcap": ("mcap_log", "log_to_mcap"),
    "read_bag": ("bags", "read_bag"),
    "to_casadi": ("casadi_residual", "CasadiResidual"),
}


def __getattr__(name: str) -> Any:
    if name not in _ASKED_FOR:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, inside = _ASKED_FOR[name]
    return getattr(import_module(f".{module}", __name__), inside)


__all__ = [
    "BagTable",
    "OnlineRegressor",
    "RiverResidual",
    "as_river",
    "log_to_lerobot",
    "log_to_mcap",
    "read_bag",
    "to_casadi",
]
