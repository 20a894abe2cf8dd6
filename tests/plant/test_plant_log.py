"""A log loses at most the trial that is being run, has one writer, and tells what is wrong with it."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from fakes import FakePlant
from made_up import trajectory

from torch_ekm._files import write_whole
from torch_ekm.description.registry import file_digests, object_paths
from torch_ekm.exceptions import (
    DescriptionError,
    FolderInUseError,
    GraspError,
    OutputError,
    ParameterError,
    StateError,
)
from torch_ekm.plant import RecordingPlant, Trajectory, TrialLog, verify_log
from torch_ekm.plant.trial_log import TrialEntry

CONFIGURATION = {"hand": "made up", "gain": 0.5}


def make(folder: Path, trials: int = 4) -> Path:
    """Trials that are decided by their number alone."""
    with TrialLog(folder, CONFIGURATION) as log:
        for trial in log.missing(range(trials)):
            log.write(trial, trajectory(trial), {"reason": "reached"})
    return folder


def wrong(folder: Path) -> list[str]:
    return [found.file for found in verify_log(folder) if found.state == "wrong"]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@contextmanager
def another_process(code: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Code that begins with the names of this file; it is killed in the end."""
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    begin = f"import sys; sys.path[:0] = {folders!r}\nfrom test_plant_log import *\n"
    command = [sys.executable, "-c", begin + code, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("log"))


def test_a_trial_says_all_about_itself(unbroken: Path) -> None:
    log = TrialLog.open(unbroken)
    assert log.trials == (0, 1, 2, 3)
    assert 3 in log
    assert 4 not in log
    recording = log.read(2)
    assert (recording.seed, len(recording.commands), len(recording.observations)) == (2, 3, 4)
    assert recording.about["configuration"] == CONFIGURATION == log.configuration
    assert recording.about["outcome"] == {"reason": "reached"}
    assert recording.about["trial"] == 2
    assert {"python", "torch", "sapien"} <= set(recording.about["versions"])
    assert log.index[2] == TrialEntry(2, 2, 3, 1.2, "lost", "reached")
    assert len(set(contents(unbroken).values())) == 5  # the trials differ


def test_a_run_in_pieces_gives_the_same_log(unbroken: Path, tmp_path: Path) -> None:
    make(tmp_path, 1)
    log = TrialLog.open(tmp_path)
    make(tmp_path, 2)
    assert [entry.trial for entry in log.index] == [0, 1]  # what is written meanwhile is seen
    (tmp_path / "trial_000002.h5.part").write_bytes(b"killed while this was written")
    (tmp_path / "trial_000077.h5.part").write_bytes(b"killed in a longer run")
    make(tmp_path)
    assert contents(tmp_path) == contents(unbroken)


def test_killed_while_writing_loses_the_current_trial_only(unbroken: Path, tmp_path: Path) -> None:
    """A real SIGKILL at a moment of its own choosing."""
    with another_process("make(Path(sys.argv[1]), 10_000)", tmp_path) as process:
        deadline = time.monotonic() + 600
        while not (tmp_path / "trial_000003.h5").exists() and time.monotonic() < deadline:
            time.sleep(0.0005)
        os.kill(process.pid, signal.SIGKILL)
    there = TrialLog.open(tmp_path).trials
    assert there == (*range(len(there)),)
    assert 4 <= len(there) < 10_000
    make(tmp_path, len(there) + 1)
    assert {found.state for found in verify_log(tmp_path)} == {"ok"}
    assert contents(unbroken).items() <= contents(tmp_path).items()


def test_a_grasp_that_failed_is_a_trial_too(tmp_path: Path) -> None:
    class Clumsy(FakePlant):
        def reset(self, seed):
            raise GraspError("slippery")

    plant, log = RecordingPlant(Clumsy()), TrialLog(tmp_path, {})
    with pytest.raises(GraspError):
        plant.reset(7)
    log.write(0, plant.trajectory, {"reason": "not grasped"})
    assert log.index == (TrialEntry(0, 7, 0, 0.0, "not grasped", "not grasped"),)
    assert log.read(0).observations == []


def test_what_is_no_log_of_this_run_is_refused(unbroken: Path, tmp_path: Path) -> None:
    before = contents(unbroken)
    with pytest.raises(ParameterError, match=r"configuration\['gain'\] = 0.7.*0.5 as in the log"):
        TrialLog(unbroken, {**CONFIGURATION, "gain": 0.7})
    with pytest.raises(ParameterError, match="about"):
        TrialLog(tmp_path / "new", {"hand": object()})
    for folder, said in ((tmp_path / "nothing", "no such log"), (tmp_path, "trial_000000")):
        with pytest.raises(DescriptionError, match=said):
            TrialLog.open(folder)
    (tmp_path / "file").touch()
    with pytest.raises(DescriptionError, match="is a file"):
        TrialLog(tmp_path / "file", {})
    with pytest.raises(OutputError, match="cannot be written"):
        TrialLog(tmp_path / "file" / "log", CONFIGURATION)
    with pytest.raises(OutputError, match=r"nowhere.*cannot be written"):
        trajectory(0).save(tmp_path / "nowhere" / "trial.h5")
    log = TrialLog.open(unbroken)
    with pytest.raises(DescriptionError, match=r"no trial 9; there are 0, 1, 2, 3"):
        log.read(9)
    with pytest.raises(StateError, match="closed, or opened to be read"):
        log.write(9, Trajectory())
    with TrialLog(unbroken, CONFIGURATION) as log:
        for trial, said in ((3, "not in the log yet"), (-1, "trial")):
            with pytest.raises(ParameterError, match=said):
                log.write(trial, Trajectory())
    assert contents(unbroken) == before


def test_a_damaged_trial_is_named_and_made_again(unbroken: Path, tmp_path: Path) -> None:
    make(tmp_path)
    torn, spoilt = tmp_path / "trial_000001.h5", tmp_path / "trial_000003.h5"
    torn.write_bytes(torn.read_bytes()[:2000])
    bits = bytearray(spoilt.read_bytes())
    bits[len(bits) // 2] ^= 8
    spoilt.write_bytes(bits)
    log = TrialLog.open(tmp_path)
    assert log.read(2).seed == 2
    with pytest.raises(DescriptionError, match=r"trial_000001\.h5: damaged"):
        log.read(1)
    assert [entry.trial for entry in log.index] == [0, 2]
    before = torn.read_bytes()
    with pytest.warns(UserWarning, match=r"\.h5: damaged.*kept as trial_00000\d\.h5\.damaged") as told:
        make(tmp_path)
    assert len(told) == 2
    asides = [tmp_path / f"{path.name}.damaged" for path in (torn, spoilt)]
    assert asides[0].read_bytes() == before
    assert wrong(tmp_path) == []
    for aside in asides:
        aside.unlink()
    assert contents(tmp_path) == contents(unbroken)


@pytest.mark.timeout(60)
def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    """A pipe would be waited for, a device be read for ever."""
    os.mkfifo(tmp_path / "trial_000000.h5")
    (tmp_path / "trial_000001.h5").symlink_to("/dev/zero")
    for trial in range(2):
        with pytest.raises(DescriptionError, match="no recording: it is no file"):
            Trajectory.load(tmp_path / f"trial_{trial:06d}.h5")
    with pytest.raises(DescriptionError, match="no file but"):
        TrialLog.open(tmp_path)


def test_every_single_bit_counts(tmp_path: Path) -> None:
    """Single bits, flipped one at a time, are all found."""
    folder = make(tmp_path, 3)
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
    folder = make(tmp_path / "log", 3)
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
    code = 'log = TrialLog(sys.argv[1], CONFIGURATION)\nprint("writing", flush=True)\ntime.sleep(1000)'
    make(tmp_path, 1)
    with another_process(code, tmp_path) as writer:
        assert writer.stdout.readline().strip() == "writing"
        with pytest.raises(FolderInUseError, match=f"process {writer.pid};"):
            TrialLog(tmp_path, CONFIGURATION)
        assert TrialLog.open(tmp_path).trials == (0,)  # readers need not wait
    with TrialLog(tmp_path, CONFIGURATION) as log:  # the system took its lock back
        with pytest.raises(FolderInUseError, match=str(os.getpid())):
            TrialLog(tmp_path, CONFIGURATION)
        log.write(1, trajectory(1))
    assert (tmp_path / ".lock").read_bytes() == b""


FULL = """
import resource
log = TrialLog(sys.argv[1], CONFIGURATION)
log.write(0, trajectory(0), {"reason": "reached"})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # what is too much is refused as a full disk would
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
try:
    log.write(1, trajectory(1, n=300))
except OutputError as error:
    print(error)
"""


def test_a_full_disk_is_told_and_leaves_the_log_as_it_was(tmp_path: Path) -> None:
    with another_process(FULL, tmp_path) as writer:
        said, _ = writer.communicate(timeout=600)
    assert writer.returncode == 0, said  # HDF5 would crash the process
    assert "trial_000001.h5 cannot be written: File too large" in said
    assert wrong(tmp_path) == []
    assert sorted(contents(tmp_path)) == [".lock", "trial_000000.h5"]
    make(tmp_path)
    assert wrong(tmp_path) == []


def test_what_is_no_file_is_not_replaced_and_a_link_stays_one(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    link.symlink_to(file)
    write_whole(link, "whole")
    assert (link.is_symlink(), file.read_text()) == (True, "whole")
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path(""), tmp_path / "n\0n"):
        with pytest.raises(OutputError):
            write_whole(path, "lost")
    assert pipe.is_fifo()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["file", "link", "pipe"]


def test_two_may_write_one_file_at_once(tmp_path: Path) -> None:
    path, texts = tmp_path / "file", ["a" * 200_000, "b" * 100_000]
    with ThreadPoolExecutor(2) as both:
        list(both.map(lambda k: write_whole(path, texts[k % 2]), range(60)))
    assert path.read_text() in texts
    assert list(tmp_path.iterdir()) == [path]
