"""The command line that the benchmarks of simulated hands share."""

from __future__ import annotations

import argparse
from pathlib import Path

from torch_ekm.cli._app import parse_seeds
from torch_ekm.simulation import ENGINES


def study_parser(
    about: str | None, name: str, *, objects: str, seeds: str, engine: str, quick: str
) -> argparse.ArgumentParser:
    """Objects, seeds, engine, processes, folder, ``--quick``.

    Args:
        about: the script's docstring.
        name: of the benchmark: results go to the folder ``NAME_output``.
        objects, seeds, engine: defaults.
        quick: what ``--quick`` leaves.
    """
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=about, formatter_class=raw)
    parser.add_argument("--objects", default=objects, help="names or paths")
    parser.add_argument("--seeds", type=parse_seeds, default=parse_seeds(seeds), help="FIRST:END")
    parser.add_argument("--engine", default=engine, choices=ENGINES)
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path(f"{name}_output"), help="keeps what is finished")
    parser.add_argument("--quick", action="store_true", help=f"{quick}: to see that it works")
    return parser
