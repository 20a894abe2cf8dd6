"""How a page of measured figures is laid out, and with which version, where and when it was written."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from pathlib import Path
from typing import NamedTuple

from torch_ekm._versions import versions_of

ROOT = Path(__file__).resolve().parents[1]
#: What decides the figures, and the peers that are measured, too.
PACKAGES = (
    "torch_ekm", "torch", "numpy", "scipy", "sapien", "mujoco", "opencv-python", "coal", "qpsolvers",
    "piqp", "numba", "gpytorch", "scikit-learn", "river", "capymoa", "stable-baselines3",
)  # fmt: skip

_MOST_ROWS = 8  # of a table that is shown; others are CSV files
_MOST_LINES = 24  # of printed text that is not folded
_PICTURE = re.compile(r"!\[(.*)\]\((\w+)\.\w+\)", re.DOTALL)


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
