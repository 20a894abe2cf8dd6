"""Which of the learners by name are compared with which."""

from __future__ import annotations

from ..learners import LEARNERS

#: Learners of other libraries: ten to a hundred times as slow, and in an extra of their own.
PEERS = ("river forest", "GPyTorch window", "GPyTorch SVGP")
#: The sparse online GP in its forms.
OURS = tuple(name for name in LEARNERS if name.startswith("SOGP"))
#: What is compared if nobody says otherwise: not those that want to know which inputs are an action.
DEFAULT = tuple(name for name in LEARNERS if name not in (*PEERS, "rbf", "action-linear"))
