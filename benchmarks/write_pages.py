"""Measure, and write the pages of docs/benchmarks.

    python benchmarks/write_pages.py generalize speed     # these pages; without names: all
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
import platform
import re
import shutil
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch_ekm._extras import versions_of

HERE = Path(__file__).parent
ROOT = HERE.resolve().parent
PAGES = ROOT / "docs" / "benchmarks"
PLAN = tomllib.loads((HERE / "pages.toml").read_text(encoding="utf-8"))

#: What decides the figures, and the peers that are measured, too.
PACKAGES = (
    "torch_ekm", "torch", "numpy", "scipy", "sapien", "mujoco", "opencv-python", "coal", "qpsolvers",
    "piqp", "numba", "gpytorch", "scikit-learn", "river", "stable-baselines3",
)  # fmt: skip

_MOST_ROWS = 8  # of a table that is shown; others are CSV files
_MOST_LINES = 24  # of printed text that is not folded
_PICTURE = re.compile(r"!\[(.*)\]\((\w+)\.\w+\)", re.DOTALL)


@dataclass(frozen=True)
class Part:
    """A command, and the question that it answers."""

    title: str
    command: str
    """Words after ``python benchmarks/``; ``{out}`` is a folder of its own, ``{data}`` that of the
    recordings."""
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
        return [sys.executable, str(HERE / words[0]), *words[1:]]

    def spoken(self) -> str:
        """The command as a reader would type it."""
        return f"python benchmarks/{self.command.format(out='FOLDER', data='DATA')}"


class Section(NamedTuple):
    """One command of a page: its result, and how it was made."""

    title: str
    see: str
    """What was asked, and of what."""
    body: str
    """Markdown; a heading for each table, the first one apart if it is that of the whole."""
    how: str
    """Command, commit, date and time."""
    picture: str = ""
    """Which one of the body's pictures is shown, by its stem."""


def page_text(
    title: str, sections: list[Section], written: list[str], name: str, files: dict[str, list[list[str]]]
) -> str:
    """A page: questions and results first, commands and versions last.

    Args:
        written: :func:`provenance`.
        name: of the page, and of the folder with its tables.
        files: takes the tables that are not shown, by the names of their files.
    """
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", "", *_laid_out(section, name, files), ""]
    made = [f"- {section.title}: {section.how}" for section in sections]
    return "\n".join([*lines, "## Commands and versions", "", *made, "", *written])


def _laid_out(section: Section, name: str, files: dict[str, list[list[str]]]) -> list[str]:
    """What was asked, the answer, a picture and a short table; other tables are files."""
    shown, links, caption, tables, kept = [section.see], [], section.title, 0, True
    for block in _blocks(section.body):
        if block.startswith("#"):
            caption = block.lstrip("# ") if block.startswith("##") else caption
        elif block.startswith("|"):
            kept = tables == 0 and _rows(block) <= _MOST_ROWS
            tables += kept
            if kept:
                shown += [*([f"### {caption}"] if caption != section.title else []), block]
                continue
            stem = re.sub(r"[^a-z0-9]+", "_", caption.lower()).strip("_")[:48]
            count = sum(re.fullmatch(rf"{stem}(_\d+)?\.csv", known) is not None for known in files)
            file = f"{stem}_{count + 1}.csv" if count else f"{stem}.csv"
            files[file] = _cells(block)
            links.append(f"[{caption}]({name}/{file})")
        elif picture := _PICTURE.fullmatch(block):  # and its caption
            if picture[2] == section.picture:
                shown.append(f"![{picture[1]}]({name}/{picture[2]}.svg)\n\n*{picture[1]}*")
        elif block.startswith("```") and block.count("\n") > _MOST_LINES + 1:
            shown.append(f"<details>\n<summary>Printed output</summary>\n\n{block}\n\n</details>")
        elif not (block.startswith("*") and not block.startswith("**")) and (kept or not tables):
            shown.append(block)  # the note of a table goes with it
    return "\n\n".join([*shown, *([f"Tables: {', '.join(links)}."] if links else [])]).splitlines()


def _blocks(body: str) -> list[str]:
    parts = re.split(r"(```.*?```)", body.strip(), flags=re.DOTALL)
    split = ([part] if part.startswith("```") else re.split(r"\n{2,}", part.strip()) for part in parts)
    return [block.strip() for blocks in split for block in blocks if block.strip()]


def _rows(markdown: str) -> int:
    return sum(line.startswith("|") for line in markdown.splitlines()) - 2


def _cells(markdown: str) -> list[list[str]]:
    lines = [line for k, line in enumerate(markdown.splitlines()) if line.startswith("|") and k != 1]
    return [
        [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines
    ]


def commit() -> str:
    """Short name of the commit, and whether tracked files differ from it; "unknown" without a repository."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], capture_output=True, text=True, check=False, cwd=ROOT)
        return done.stdout.strip()

    outside = ":(exclude)docs"  # where pages are written
    changed = " with changes" if git("status", "--porcelain", "--untracked-files=no", ".", outside) else ""
    return (git("rev-parse", "--short", "HEAD") or "unknown") + changed


def provenance(command: str) -> list[str]:
    """Command, kind of machine and versions, as lines of Markdown.

    Args:
        command: that writes the page, in a checkout.
    """
    versions = (
        f"{name} {found}" for name, found in versions_of(PACKAGES).items() if found != "not installed"
    )
    machine = f"{platform.machine()} {platform.system()}, {os.cpu_count()} cores, {_processor()}"
    return [f"Written by `{command}` on {machine}; {', '.join(versions)}.", ""]


def _processor() -> str:
    """Its model, where Linux states it."""
    source = Path("/proc/cpuinfo")
    lines = source.read_text(encoding="utf-8").splitlines() if source.exists() else []
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")),
        "unknown processor",
    )


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
    options = parser.parse_args(arguments)
    unknown = [name for name in options.pages if name not in PLAN]
    if unknown:
        parser.error(f"no page {', '.join(unknown)}; there are {', '.join(PLAN)}")
    for name in options.pages or PLAN:
        folder = options.out if options.quick else PAGES
        write(name, options.out, folder / f"{name}.md", options.quick, options.keep)


if __name__ == "__main__":
    main()
