"""A turn as one movement: what a plan is worth without a learner, and what f that adapts and g add to it.

    python benchmarks/whole_turn.py --objects box,can,bottle --seeds 0:2

Hands: preset nominal, and three that lose objects. A session is one object, hand, seed and contender: turns
of 14, -8 and 22 deg, in which the hand is learned, then 9, 19 and 27 deg, each from a fresh grasp, the same
for all. The camera has 20 Hz and is 0.05 s late. Parts of the plan, changed or left out: ``matrix.py plan``.
"""

from __future__ import annotations

from collections.abc import Sequence

from matrix import ask
from questions import QUESTIONS


def main(arguments: Sequence[str] | None = None) -> None:
    ask(QUESTIONS["whole_turn"], arguments, __doc__)


if __name__ == "__main__":
    main()
