"""``matrix.py whole_turn``: what a plan is worth without a learner, and what f that adapts and g add to it.

python benchmarks/whole_turn.py --objects box,can,bottle --seeds 0:2
"""

from __future__ import annotations

import sys

from matrix import ask
from questions import QUESTIONS

if __name__ == "__main__":
    ask(QUESTIONS["whole_turn"], sys.argv[1:])
