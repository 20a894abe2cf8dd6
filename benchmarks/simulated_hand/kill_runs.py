"""What is left of runs that are killed, and of a log whose bits flip? ``kill_runs.py [--quick]``

``torch-ekm record`` (camera, Hall sensors, images) and ``torch-ekm reproduce`` (two processes) run to their
end once, and then are killed (SIGKILL) at random moments, 30 times each; a run that reached its end starts
again. After each kill: every finished file is byte by byte what it was before, a recorded trial is that of
the unbroken run, a result is its job's, and no process is left after fifteen seconds (one that is still
importing ends when it has imported). Results of two runs are equal but for the seconds of the wall. In the
end ``verify_log`` is asked about 400 single bits of the log, flipped one at a time. ``--quick``: three kills
each, 60 bits, no camera.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from torch_ekm.experiments.jobs import read_result
from torch_ekm.plant import verify_log

COMMAND = [sys.executable, "-c", "from torch_ekm.cli import main; main()"]
_PATIENCE = 15.0  # [s]


@dataclass
class Tally:
    """What came of the kills of one command."""

    kills: int = 0
    finished: int = 0
    """Files that were whole at a kill, all kills together."""
    rounds: int = 0
    """Runs that reached their end."""
    lost: list[str] = field(default_factory=list)
    """Files that were gone or changed."""
    wrong: list[str] = field(default_factory=list)
    """Files that are not what an unbroken run leaves."""
    left: int = 0
    """Processes that were still there."""

    def __str__(self) -> str:
        return (
            f"{self.kills} kills, {self.rounds} runs to the end: of {self.finished} finished files "
            f"{len(self.lost)} lost or changed, {len(self.wrong)} not those of an unbroken run; "
            f"{self.left} processes left"
        )


def record_command(folder: Path, sensing: bool) -> list[str]:
    camera = ["--sensing", "--images"] if sensing else ["--no-sensing"]
    return [*COMMAND, "record", str(folder), "--seeds", "0:1", "--angles", "3,5,4", *camera]


def reproduce_command(folder: Path) -> list[str]:
    small = ["generalize", "--quick", "--objects", "box", "--angles", "3", "--seeds", "0:1", "--no-sensing"]
    return [*COMMAND, "reproduce", *small, "--jobs", "2", "--out", str(folder)]


def kill_often(
    command: list[str],
    folder: Path,
    finished: Callable[[Path], dict[str, Any]],
    unbroken: Path,
    kills: int,
    seconds: float,
    seed: int = 0,
) -> Tally:
    """Run and kill; ``finished`` gives what there is of whole files, as two runs should have it."""
    draw, tally, whole = random.Random(seed), Tally(), finished(unbroken)
    while tally.kills < kills:
        before = digests(folder)
        run = subprocess.Popen(
            command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            run.wait(draw.uniform(0.1, 1.0) * seconds)
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
            tally.kills += 1
        ended = run.returncode == 0
        tally.left += len(still_there(run.pid))
        after = digests(folder)
        tally.lost += [name for name, digest in before.items() if after.get(name) != digest]
        there = finished(folder)
        tally.wrong += [name for name, content in there.items() if whole.get(name) != content]
        if ended:
            tally.rounds += 1
            tally.wrong += [name for name in whole if name not in there]
            shutil.rmtree(folder)
        else:
            tally.finished += len(there)
            print(f"  {len(there)} of {len(whole)} are there; {tally}", file=sys.stderr)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    tally.rounds += 1
    there = finished(folder)
    tally.wrong += [name for name in whole if there.get(name) != whole[name]]
    return tally


def still_there(session: int) -> list[psutil.Process]:
    """Processes of a session, those that end within some seconds left out."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    left = psutil.wait_procs(found, timeout=_PATIENCE)[1]
    for process in left:
        process.kill()
    return left


def digests(folder: Path) -> dict[str, str]:
    """Of every finished file."""
    files = [*folder.glob("*.h5"), *folder.glob("runs/*.json")]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def trials(folder: Path) -> dict[str, Any]:
    """What is recorded, byte by byte."""
    return {path.name: path.read_bytes() for path in folder.glob("*.h5")}


def results(folder: Path) -> dict[str, Any]:
    """What the jobs left, without the time that they took."""
    found = {}
    for path in folder.glob("runs/*.json"):
        records = read_result(path, path.stem)
        found[path.name] = json.dumps([{**one, "seconds": len(one.get("seconds", ()))} for one in records])
    return found


def flipped_bits(folder: Path, flips: int, seed: int = 0) -> tuple[int, int]:
    """How many single bits ``verify_log`` finds in the file that they are in, and of how many."""
    draw, found = random.Random(seed), 0
    whole = {path: path.read_bytes() for path in sorted(folder.iterdir()) if path.stat().st_size}
    for _ in range(flips):
        path = draw.choices(list(whole), [len(content) for content in whole.values()])[0]
        bit = draw.randrange(8 * len(whole[path]))
        content = bytearray(whole[path])
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        found += [one.file for one in verify_log(folder) if one.state == "wrong"] == [path.name]
        path.write_bytes(whole[path])
    return found, flips


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--only", choices=("record", "reproduce", "bits"), default=None)
    options = parser.parse_args()
    kills, sensing, flips = (3, False, 60) if options.quick else (options.kills, True, 400)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        log = root / "log"
        if options.only != "reproduce":
            seconds = timed(record_command(log, sensing))
            print(f"record, {'camera and images' if sensing else 'no camera'}: {seconds:.0f} s unbroken")
        if options.only in (None, "record"):
            again = root / "log_again"
            command = record_command(again, sensing)
            print("record:", kill_often(command, again, trials, log, kills, seconds), flush=True)
        if options.only in (None, "reproduce"):
            report, again = root / "report", root / "report_again"
            seconds = timed(reproduce_command(report))
            print(f"reproduce: {seconds:.0f} s unbroken")
            outcome = kill_often(reproduce_command(again), again, results, report, kills, seconds)
            print("reproduce:", outcome, flush=True)
        if options.only in (None, "bits"):
            print("bits: {} of {} found".format(*flipped_bits(log, flips)), flush=True)


def timed(command: list[str]) -> float:
    began = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - began


if __name__ == "__main__":
    main()
