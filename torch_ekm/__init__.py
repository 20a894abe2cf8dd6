"""torch_ekm: kinematic models of underactuated hands, corrected by online learners.

``import torch_ekm`` needs torch and numpy only. The rooms of the house, in the order
in which data flows: :mod:`~torch_ekm.description`, :mod:`~torch_ekm.kinematics`,
:mod:`~torch_ekm.contact`, :mod:`~torch_ekm.model`, :mod:`~torch_ekm.residual`
(knows nothing of robots), :mod:`~torch_ekm.enhanced`, :mod:`~torch_ekm.control`,
:mod:`~torch_ekm.simulation`, :mod:`~torch_ekm.sensing`, :mod:`~torch_ekm.experiments`.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("torch_ekm")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
