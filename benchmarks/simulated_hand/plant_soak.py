"""Does the simulated hand survive a long run, and its log a kill? ``plant_soak.py --trials 1000``

A trial is a random pinch of the box, turned by 3 or 5 deg by the kinematic model at preset "nominal",
logged. Reports the growth of the process' memory, how much faster than real time a closed-loop trial is
(one core), whether two runs of the same seeds leave the same bytes, and what is left of a run that is
killed (SIGKILL) at random moments. ``--sensing`` puts camera and Hall sensors into the loop. Quick:
``--trials 60 --kills 2``.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import torch

from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.protocols.record import RecordConfig, record
from torch_ekm.plant import TrialLog

ANGLES = (3.0, 5.0)
_WARM_UP = 50  # trials until all caches are filled


def config(sensing: bool) -> RecordConfig:
    """What every run here does."""
    return RecordConfig(Setting(sensing=sensing), angles_deg=ANGLES)


def memory() -> float:
    """Resident memory of this process [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def digests(folder: Path) -> dict[str, str]:
    """Of every file of a log."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def long_run(folder: Path, trials: int, sensing: bool) -> None:
    """Memory and speed."""
    sizes: dict[int, float] = {}
    spent, began = 0.0, time.process_time()
    for seed in range(trials // len(ANGLES)):
        log = record(config(sensing), (seed,), folder)
        done = len(log)
        at_end = seed == trials // len(ANGLES) - 1
        if not at_end and (done < _WARM_UP or done - max(sizes, default=0) < _WARM_UP):
            continue
        spent += time.process_time() - began  # without the time of this report
        sizes[done] = memory()
        simulated = sum(entry.time for entry in log.index)
        print(
            f"  {done} trials, {sizes[done]:.1f} MB; {simulated:.0f} s simulated in {spent:.0f} s of CPU: "
            f"{simulated / spent:.1f} times real time",
            flush=True,
        )
        began = time.process_time()
    ends = Counter(entry.reason for entry in TrialLog.open(folder).index)
    first, last = min(sizes), max(sizes)
    print(
        f"from trial {first} to {last} memory changed by {sizes[last] - sizes[first]:+.1f} MB, at most by "
        f"{max(sizes.values()) - sizes[first]:+.1f} MB; the trials ended: {dict(ends)}"
    )


def killed_run(
    unbroken: Path, folder: Path, trials: int, kills: int, sensing: bool, seed: int, trial_time: float
) -> None:
    """Kill a logged run ``kills`` times, finish it, compare it with one that was never stopped."""
    whole = {name: digest for name, digest in digests(unbroken).items() if name.endswith(".h5")}
    draw, lost, torn = random.Random(seed), 0, 0
    command = [sys.executable, __file__, "--worker", str(folder), "--trials", str(trials)]
    command += ["--sensing"] if sensing else []
    for kill in range(kills):
        before = [path.name for path in folder.glob("*.h5")]
        worker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert worker.stdout is not None
        for _ in range(draw.randint(0, 3) + len(list(folder.glob("*.h5")))):
            worker.stdout.readline()  # a trial is done, or was done earlier
        time.sleep(draw.uniform(0.0, 1.5 * trial_time))
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        torn += len(list(folder.glob("*.part")))
        there = len(list(folder.glob("*.h5")))
        if there:
            TrialLog.open(folder)  # the index is mended
        after = digests(folder) if there else {}
        # trials that were there before, and those that were not run to their end in the way that they should
        lost += sum(name not in after for name in before)
        lost += sum(after[name] != digest for name, digest in whole.items() if name in after)
        print(f"  kill {kill + 1}: {there} of {trials} trials are there", flush=True)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    same = digests(folder) == digests(unbroken)
    print(
        f"{kills} kills: {lost} finished trials lost or changed, {torn} files torn (none taken for a trial); "
        f"the finished log {'equals' if same else 'DIFFERS FROM'} an unbroken run's"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=8)
    parser.add_argument("--killed-trials", type=int, default=30, help="length of the run that is killed")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("--sensing", action="store_true")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.worker is not None:
        seeds = tuple(range(options.trials // len(ANGLES)))
        record(config(options.sensing), seeds, options.worker, lambda trial: print(trial, flush=True))
        return
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        if options.trials:
            long_run(folder / "long", options.trials, options.sensing)
        if options.kills:
            seeds = tuple(range(options.killed_trials // len(ANGLES)))
            trials = len(seeds) * len(ANGLES)
            for name in ("first", "second"):
                began = time.perf_counter()
                record(config(options.sensing), seeds, folder / name)
                trial_time = (time.perf_counter() - began) / trials
            same = digests(folder / "first") == digests(folder / "second")
            print(f"two runs of {trials} trials: {'the same' if same else 'DIFFERENT'} bytes")
            killed_run(
                folder / "first",
                folder / "killed",
                trials,
                options.kills,
                options.sensing,
                options.seed,
                trial_time,
            )


if __name__ == "__main__":
    main()
