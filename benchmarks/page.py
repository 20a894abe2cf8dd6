"""What heads every page of measured figures: with which version, where and when it was written."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

from torch_ekm._versions import versions_of

ROOT = Path(__file__).resolve().parents[1]
#: What decides the figures, and the peers that are measured, too.
PACKAGES = (
    "torch_ekm", "torch", "numpy", "scipy", "sapien", "coal", "qpsolvers", "piqp", "numba",
    "gpytorch", "scikit-learn", "river", "capymoa",
)  # fmt: skip


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
