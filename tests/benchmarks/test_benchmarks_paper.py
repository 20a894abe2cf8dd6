"""The page of the paper's numbers: a row for each, from made-up sessions."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "experiments"))


from made_up_sessions import made_up_generalize, made_up_online

from paper import main, mean_text
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.online import Online


def test_every_number_of_the_paper_stands_beside_ours(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(Generalize, "session", made_up_generalize)
    monkeypatch.setattr(Online, "session", made_up_online)
    main(["--quick", "--seeds", "0:1", "--jobs", "1", "--out", str(tmp_path)])
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    found = {row[0].removeprefix("| "): row[1:] for row in rows}
    assert mean_text(None) == "1.62; 0.64; 40 %"
    assert found["Table II: mean error [deg], KM; E-KM; ratio"][0] == "1.62; 0.64; 40 %"
    assert found["Fig. 5b: last index of negative result"][0] == "16"
    assert " of 2, least " in found["Fig. 6: cells that the E-KM wins"][1]
    assert all(len(row) == 3 for name, row in found.items() if name.startswith("Fig."))
    assert (tmp_path / "overview.svg").stat().st_size > 1000
