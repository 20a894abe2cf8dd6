"""The command of a study: its protocol, run over seeds into a folder with a report."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from torch_ekm._terminal import print_report, progress
from torch_ekm.cli._app import parse_seeds
from torch_ekm.experiments.protocols.protocol import Protocol
from torch_ekm.experiments.reproduce import REPORTED_SEEDS, Experiment, reproduce
from torch_ekm.simulation import ENGINES


def run_study(protocol: Protocol, about: str | None) -> None:
    """Run it as the command line says.

    Args:
        about: what ``--help`` prints.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=parse_seeds, default=REPORTED_SEEDS, help="FIRST:END")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for the report; keeps what is finished"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--quick", action="store_true", help="small turns: to see that it works")
    parser.add_argument("--engine", default=protocol.setting.engine, choices=ENGINES)
    options = parser.parse_args()
    protocol = dataclasses.replace(
        protocol, setting=dataclasses.replace(protocol.setting, engine=options.engine)
    )
    planned = Experiment(protocol, options.seeds)
    if options.quick:
        planned = Experiment(protocol.quick(), options.seeds[: protocol.quick_seeds], quick=True)
    with progress("running", len(planned.jobs)) as advance:
        report = reproduce(planned, options.out, options.jobs, advance)
    print_report(report, options.out)
