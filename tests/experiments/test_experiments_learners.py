"""Names of learners, and the page that tells what each is made with."""

import re
from pathlib import Path

from torch_ekm import residual
from torch_ekm._recorded import describe, differences
from torch_ekm.experiments.learners import COMPARED, LEARNERS

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "choose_a_learner.md"


def test_the_page_has_the_call_of_each_name() -> None:
    section = PAGE.read_text(encoding="utf-8").split("## Names in")[1].split("\n## ")[0]
    rows = [row.strip("| ").split(" | ") for row in section.splitlines() if "`" in row and row[0] == "|"]
    calls = dict(
        pair
        for names, text in rows
        for pair in zip(names.split(", "), re.findall("`(.*?)`", text), strict=False)
    )
    assert calls.keys() == {*COMPARED}
    del calls["SOGP mixture"]  # in words
    for name, call in calls.items():
        if call.startswith("parts="):
            call = f"SparseOnlineGP(d, m, kernel=SquaredExponential(d), {call})"
        if "parts=" in call:
            call = f"{call[:-1]}, standardize=False)"
        written = describe(eval(call, {**vars(residual), "d": 3, "m": 2}))
        made = describe(LEARNERS[name](3, 2))
        assert made["class"] == written["class"]
        assert not differences(made, written, {}), name
