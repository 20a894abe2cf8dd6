"""Measure, and write the pages of docs/benchmarks.

    python benchmarks/write_pages.py generalize speed     # these pages; without names: all
    python benchmarks/write_pages.py --list               # every page with its commands
    python benchmarks/write_pages.py speed --quick        # to see that it works; writes to --out only

pages.toml names the commands of each page. A page is made of what they print, or of the reports that they
leave; both are kept in ``--out``. Stopped and started again, it goes on with what is missing. What another
commit has measured is measured again, unless ``--keep`` says that nothing has changed that matters to it.
Recordings are read from ``TORCH_EKM_DATA``.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

from page import ROOT, Section, commit, page_text, provenance

HERE = Path(__file__).parent
PAGES = ROOT / "docs" / "benchmarks"
PLAN = tomllib.loads((HERE / "pages.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Part:
    """A command, and the question that it answers."""

    title: str
    command: str
    """Words after ``python benchmarks/``, or ``torch-ekm ...``; ``{out}`` is a folder of its own, ``{data}``
    that of the recordings."""
    see: str
    quick: str = "--quick"
    """What makes it short."""
    text: bool = False
    """It prints text, not Markdown."""
    picture: str = ""
    """The figure of its report that the page shows."""

    @property
    def reports(self) -> bool:
        """It leaves a report in ``{out}``."""
        return "{out}" in self.command

    def words(self, out: Path, quick: bool) -> list[str]:
        """The command as it is run."""
        data = os.environ.get("TORCH_EKM_DATA", "TORCH_EKM_DATA")
        words = f"{self.command} {self.quick if quick else ''}".format(out=out, data=data).split()
        if words[0] == "torch-ekm":
            return [sys.executable, "-c", "from torch_ekm.cli import main; main()", *words[1:]]
        return [sys.executable, str(HERE / words[0]), *words[1:]]

    def spoken(self) -> str:
        """The command as a reader would type it."""
        words = self.command.format(out="FOLDER", data="DATA")
        return words if words.startswith("torch-ekm") else f"python benchmarks/{words}"


def parts_of(name: str) -> list[Part]:
    """The commands of a page."""
    return [Part(**part) for part in PLAN[name]["parts"]]


def measure(part: Part, folder: Path, quick: bool, keep: bool) -> dict[str, str]:
    """What a command printed or reported, from ``folder`` if it is there."""
    kept, now, spoken = folder / "measured.json", commit(), f"{part.spoken()} {part.quick if quick else ''}"
    if kept.exists():
        found = json.loads(kept.read_text(encoding="utf-8"))
        if found["command"] == spoken and (keep or found["commit"] == now):
            return found
    started = folder / "started.txt"
    if folder.exists() and not (keep or (started.exists() and started.read_text(encoding="utf-8") == now)):
        shutil.rmtree(folder)  # a command would go on with what another commit has left
    words = part.words(folder / "report", quick)
    folder.mkdir(parents=True, exist_ok=True)
    started.write_text(now, encoding="utf-8")
    print(f"{part.spoken()} ...", flush=True)
    begin = time.time()
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **os.environ}
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT, env=environment)
    found = {
        "command": spoken,
        "commit": now,
        "date": str(datetime.date.today()),
        "minutes": f"{(time.time() - begin) / 60:.0f}",
        "body": done.stdout,
    }
    kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


def write(name: str, out: Path, page: Path, quick: bool, keep: bool) -> None:
    """A page, and the pictures that it shows."""
    sections = []
    for k, part in enumerate(parts_of(name)):
        folder = out / name / str(k)
        found = measure(part, folder, quick, keep)
        body = found["body"].strip()
        if part.text:
            body = f"```text\n{body}\n```"
        elif part.reports:
            body = (folder / "report" / "report.md").read_text(encoding="utf-8")
        how = f"`{part.spoken()}`: commit {found['commit']}, {found['date']}, {found['minutes']} min."
        sections.append(Section(part.title, part.see, body, how, part.picture))
        (page.parent / name).mkdir(parents=True, exist_ok=True)
        if part.picture:
            shutil.copy(folder / "report" / f"{part.picture}.svg", page.parent / name)
    written = provenance(f"python benchmarks/write_pages.py {name}")
    files: dict[str, list[list[str]]] = {}
    page.write_text(page_text(PLAN[name]["title"], sections, written, name, files), encoding="utf-8")
    for file, rows in files.items():
        with (page.parent / name / file).open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerows(rows)
    print(f"{page}", flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", metavar="page", help=", ".join(PLAN))
    parser.add_argument("--out", type=Path, default=ROOT / "benchmark_output", help="where results are kept")
    parser.add_argument("--quick", action="store_true", help="to see that it works; pages go to --out")
    parser.add_argument("--keep", action="store_true", help="use what other commits have measured")
    parser.add_argument("--list", action="store_true", help="print the commands and end")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.pages if name not in PLAN]
    if unknown:
        parser.error(f"no page {', '.join(unknown)}; there are {', '.join(PLAN)}")
    for name in options.pages or PLAN:
        if options.list:
            print(name, *(f"    {part.spoken()}" for part in parts_of(name)), sep="\n")
        else:
            folder = options.out if options.quick else PAGES
            write(name, options.out, folder / f"{name}.md", options.quick, options.keep)


if __name__ == "__main__":
    main()
