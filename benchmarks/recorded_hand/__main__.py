"""Predict the recorded motions of a Yale T42 hand.

    python benchmarks/recorded_hand --data t42_testpaths.npz

With its kinematic model, with and without learners. The recordings (Sintov et al., GitHub
avishais/t42_autonomous_system) are read in place; docs/how_to/compare_on_your_data.md says how to save them
as npz. Without ``--data`` a small synthetic set is made.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from recorded_hand.benchmark import predict_recorded_hand
from recorded_hand.report import write_report

from torch_ekm._terminal import print_report


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="t42_testpaths.npz or its folder")
    parser.add_argument("--learners", default="SOGP mixture", help="names, separated by commas")
    parser.add_argument(
        "--out", type=Path, default=Path("recorded_hand_output"), help="folder for the report"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument(
        "--quick", action="store_true", help="two paths of four objects: to see that it works"
    )
    options = parser.parse_args()
    chosen = tuple(filter(None, map(str.strip, options.learners.split(","))))
    result = predict_recorded_hand(
        options.data, learners=chosen, processes=options.jobs, quick=options.quick
    )  # fmt: skip
    print_report(write_report(result, options.out), options.out, notes=True)


if __name__ == "__main__":
    main()
