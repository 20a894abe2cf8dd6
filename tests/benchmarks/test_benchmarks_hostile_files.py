"""Files that are damaged or made to do harm; the benchmark has more of them, and watches who reads them."""

from collections import Counter
from pathlib import Path

import hostile_files
import pytest

from torch_ekm.exceptions import EKMError


def test_what_is_good_can_be_read(tmp_path: Path) -> None:
    for kind, one in hostile_files.KINDS.items():
        path = tmp_path / kind / one.name
        path.parent.mkdir(parents=True)
        one.write(path)
        assert hostile_files.read_one(kind, path).what == "read", kind


def test_what_is_not_is_refused_at_once(tmp_path: Path) -> None:
    found: Counter[str] = Counter()
    for kind, what, path in hostile_files.hostile(tmp_path, 60, seed=0):
        outcome = hostile_files.read_one(kind, path)
        assert outcome.what in ("read", "refused"), f"{kind}, {what}: {outcome.what}"
        assert outcome.memory < hostile_files.LARGEST, f"{kind}, {what}: {outcome.memory >> 20} MB"
        found[outcome.what] += 1
    assert found["refused"] > 30


@pytest.mark.parametrize("kind", ["learner", "trial", "csv", "parquet", "mcap", "urdf", "wiring"])
def test_no_path_is_waited_for(kind: str, tmp_path: Path) -> None:
    for number, (what, make) in enumerate(hostile_files.PLACES.items()):
        (tmp_path / f"{number}").mkdir()
        path = tmp_path / f"{number}" / hostile_files.KINDS[kind].name
        make(path)
        with pytest.raises(EKMError):
            hostile_files.KINDS[kind].read(path)
        assert hostile_files.read_one(kind, path).what == "refused", what


ANNOUNCE = {
    ("learner", "capacity"): "announce",
    ("learner", "capacity, 1e9"): "announce",
    ("learner", "array"): "damaged",
    ("learner", "overlapping"): "larger than the file",
    ("trial", "unwritten"): "announce",
    ("trial", "texts"): "no figures",
    ("trial", "elsewhere"): "lies in another file",
    ("csv", "wide"): "at most 4096",
    ("csv", "a long field"): "more than 1048576 characters",
}


@pytest.mark.parametrize(("kind", "what"), ANNOUNCE)
def test_what_asks_for_more_than_there_is_is_refused_for_it(kind: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / hostile_files.KINDS[kind].name
    hostile_files.KINDS[kind].made[what](path)
    with pytest.raises(EKMError, match=ANNOUNCE[kind, what]):
        hostile_files.KINDS[kind].read(path)
