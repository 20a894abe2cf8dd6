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

_MOST_ROWS = {True: 10, False: 16}  # of a table that is not folded, with a picture of it and without
_MOST_LINES = 24  # of printed text that is not folded


class Section(NamedTuple):
    """One command of a page: its result, and how it was made."""

    title: str
    see: str
    body: str
    """Markdown; a heading of the third level for each table."""
    how: str
    """Command, commit, date and time."""


def page_text(title: str, sections: list[Section], written: list[str]) -> str:
    """A page: results first, commands and versions last.

    Args:
        written: :func:`provenance`.
    """
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", "", *_laid_out(section.see, section.body), ""]
    made = [f"- {section.title}: {section.how}" for section in sections]
    return "\n".join([*lines, "## Commands and versions", "", *made, "", *written])


def _laid_out(see: str, body: str) -> list[str]:
    """The answer, a picture and a short first table, then what to see in them; all else is folded."""
    lead, *tables = re.split(r"^### ", body.strip(), flags=re.MULTILINE)
    blocks = [block for block in re.split(r"\n{2,}", lead.strip()) if block] if "```" not in lead else [lead]
    first, rest = [], []
    most = _MOST_ROWS["![" in lead]
    while blocks:
        block = blocks.pop(0).strip()
        if block.startswith("!["):  # and its caption
            picture = "\n\n".join([block, *([blocks.pop(0)] if blocks and blocks[0].startswith("*") else [])])
            (rest if any("![" in one for one in first) else first).append(picture)
        elif block.startswith("|") and _rows(block) > most:
            rest.append(_folded(f"Table of {_rows(block)} rows", block))
        elif block.startswith("```") and block.count("\n") > _MOST_LINES + 1:
            rest.append(_folded("Printed output", block))
        else:
            (rest if block.startswith("- **") else first).append(block)
    for k, table in enumerate(tables):
        caption, _, text = table.partition("\n")
        short = k == 0 and _rows(text) <= most
        (first if short else rest).append(
            f"### {caption}\n\n{text.strip()}" if short else _folded(caption, text.strip())
        )
    first = [*first, see] if "![" in lead else [see, *first]
    return "\n\n".join([*first, *rest]).splitlines()


def _rows(markdown: str) -> int:
    return sum(line.startswith("|") for line in markdown.splitlines()) - 2


def _folded(caption: str, text: str) -> str:
    """HTML around Markdown, which begins after an empty line."""
    return f"<details>\n<summary>{caption}</summary>\n\n{text}\n\n</details>"


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
