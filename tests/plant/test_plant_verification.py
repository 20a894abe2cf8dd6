"""One writer at a time, and what happened to a log's bytes is told."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torch_ekm.description.registry import file_digests, object_paths
from torch_ekm.exceptions import FolderInUseError, OutputError
from torch_ekm.plant import Observation, PlantStatus, Trajectory, TrialLog, verify_log

pytest.importorskip("h5py")

CONFIGURATION = {"hand": "made up", "gain": 0.5}


def trajectory(seed: int, n: int = 3) -> Trajectory:
    """Commands and readings that are decided by the seed."""
    numbers = torch.Generator().manual_seed(seed)
    rows = torch.rand(n + 1, 4, generator=numbers, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    seen = [
        Observation(
            row, row[:2], row[:3], eye, row[:2], 0.1 * k, PlantStatus.HELD,
            {"raw": {"image": (255 * row).to(torch.uint8).expand(20, 4)}},
        )
        for k, row in enumerate(rows)
    ]  # fmt: skip
    return Trajectory(seed, [row[:2] for row in rows[1:]], seen)


def make(folder: Path, trials: int = 3) -> Path:
    with TrialLog(folder, CONFIGURATION) as log:
        for trial in log.missing(range(trials)):
            log.write(trial, trajectory(trial), {"reason": "reached"})
    return folder


def wrong(folder: Path) -> list[str]:
    return [found.file for found in verify_log(folder) if found.state == "wrong"]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_every_single_bit_counts(tmp_path: Path) -> None:
    """Single bits, flipped one at a time, are all found."""
    folder = make(tmp_path)
    assert wrong(folder) == []
    whole = {name: content for name, content in contents(folder).items() if content}
    draw = random.Random(0)
    for _ in range(60):
        name = draw.choices(list(whole), [len(content) for content in whole.values()])[0]
        bit = draw.randrange(8 * len(whole[name]))
        flipped = bytearray(whole[name])
        flipped[bit // 8] ^= 1 << bit % 8
        (folder / name).write_bytes(flipped)
        assert wrong(folder) == [name], bit
        (folder / name).write_bytes(whole[name])
    for name in whole:  # every kind of file, its first bit and its last
        for place in (0, -1):
            flipped = bytearray(whole[name])
            flipped[place] ^= 1
            (folder / name).write_bytes(flipped)
            assert wrong(folder) == [name]
        (folder / name).write_bytes(whole[name])


def test_files_in_the_wrong_place_are_told(tmp_path: Path) -> None:
    folder = make(tmp_path / "log")
    other = tmp_path / "other"
    with TrialLog(other, {**CONFIGURATION, "gain": 0.7}) as log:
        log.write(1, trajectory(1))
    one, two = folder / "trial_000001.h5", folder / "trial_000002.h5"
    kept = one.read_bytes()
    one.write_bytes(two.read_bytes())  # a whole file, of another trial
    assert wrong(folder) == [one.name]
    one.write_bytes((other / one.name).read_bytes())  # of another configuration
    assert wrong(folder)[0] == one.name
    one.unlink()
    assert wrong(folder) == []
    one.write_bytes(kept)
    assert wrong(folder) == []
    (folder / "trial_000005.h5.part").write_bytes(b"killed")
    assert verify_log(folder)[-1][:2] == ("trial_000005.h5.part", "left over")
    assert wrong(tmp_path / "nowhere") == [str(tmp_path / "nowhere")]


def test_a_damaged_trial_is_made_again(tmp_path: Path) -> None:
    folder = make(tmp_path)
    whole = contents(folder)
    for name in ("trial_000000.h5", "trial_000002.h5"):
        damaged = bytearray(whole[name])
        damaged[len(damaged) // 2] ^= 8
        (folder / name).write_bytes(damaged)
    with pytest.warns(UserWarning, match="damaged") as told:
        make(folder)
    assert len(told) == 2
    after = contents(folder)
    assert {name: after[name] for name in whole} == whole
    assert sorted({*after} - {*whole}) == ["trial_000000.h5.damaged", "trial_000002.h5.damaged"]
    assert wrong(folder) == []


def test_what_it_was_made_from(tmp_path: Path) -> None:
    for source, suffix in zip(object_paths("box"), (".urdf", ".object.toml"), strict=True):
        (tmp_path / f"mine{suffix}").write_bytes(source.read_bytes())
    urdf = str(tmp_path / "mine.urdf")
    files = file_digests("planar_two_finger", [urdf])
    configuration = {"hand": "planar_two_finger", "object": urdf, "files": files}
    with TrialLog(tmp_path / "log", configuration) as log:
        log.write(0, trajectory(0))
    assert wrong(tmp_path / "log") == []
    with (tmp_path / "mine.object.toml").open("a") as file:
        file.write("# corrected\n")
    assert wrong(tmp_path / "log") == ["object mine.object.toml"]
    (tmp_path / "mine.urdf").unlink()
    assert wrong(tmp_path / "log") == ["(sources)"]


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    code = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_plant_verification import CONFIGURATION, TrialLog, trajectory
log = TrialLog({str(tmp_path)!r}, CONFIGURATION)
log.write(0, trajectory(0))
print("writing", flush=True)
time.sleep(1000)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline().strip() == "writing"
            with pytest.raises(FolderInUseError, match=f"process {writer.pid};"):
                TrialLog(tmp_path, CONFIGURATION)
            assert TrialLog.open(tmp_path).trials == (0,)  # readers need not wait
        finally:
            writer.kill()
    with TrialLog(tmp_path, CONFIGURATION) as log:  # the system took its lock back
        with pytest.raises(FolderInUseError, match=str(os.getpid())):
            TrialLog(tmp_path, CONFIGURATION)
        log.write(1, trajectory(1))
    assert (tmp_path / ".lock").read_bytes() == b""


FULL = """
import resource, signal, sys
sys.path.insert(0, sys.argv[1])
from test_plant_verification import CONFIGURATION, TrialLog, trajectory
from torch_ekm.exceptions import OutputError
log = TrialLog(sys.argv[2], CONFIGURATION)
log.write(0, trajectory(0))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # what is too much is refused as a full disk would
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
try:
    log.write(1, trajectory(1, n=300))
except OutputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process")
def test_a_full_disk_is_told_and_leaves_the_log_as_it_was(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL, str(Path(__file__).parent), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr  # HDF5 would crash the process
    assert "trial_000001.h5 cannot be written: File too large" in done.stdout
    assert wrong(tmp_path) == []
    assert sorted(contents(tmp_path)) == [".lock", "trial_000000.h5"]
    make(tmp_path)
    assert wrong(tmp_path) == []


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        TrialLog(tmp_path / "file" / "log", CONFIGURATION)
    with pytest.raises(OutputError, match=r"nowhere.*cannot be written"):
        trajectory(0).save(tmp_path / "nowhere" / "trial.h5")
