"""Streams that are compared, from tables and recordings: a broken file is named by line and column."""

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import torch
from pyarrow import parquet
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.exceptions import DescriptionError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.experiments import Columns, compare, load_own
from torch_ekm.experiments.learner_comparison.plots import plot_scores
from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.experiments.learner_comparison.recordings import load_recording
from torch_ekm.experiments.learner_comparison.run import run_one
from torch_ekm.experiments.learner_comparison.stream import Stream, load_table
from torch_ekm.experiments.learner_comparison.table_file import open_table
from torch_ekm.experiments.learners import learner_factory
from torch_ekm.experiments.reporting.plots import COLOURS
from torch_ekm.residual import UpdateReport, ZeroResidual


def table(n: int = 60) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, 4))


def stream_of(x: np.ndarray, y: np.ndarray, **options: bool) -> Stream:
    return Stream("a", torch.tensor(x), torch.tensor(y)).stream(**options)


def write(path: Path, values: np.ndarray, names: str = "a,b,c,y") -> Path:
    np.savetxt(path, values, delimiter=",", header=names, comments="")
    return path


GOOD = "1,2,3\n" * 50
BROKEN = {
    "text": ("a,b,y\n1,2,3\n4,wood,6\n", r"line 3, column 'b': 'wood' is no number"),
    "missing": ("a,b,y\n1,2,3\n4,,6\n", r"line 3, column 'b' is empty"),
    "nan": ("a,b,y\n1,2,3\n4,nan,6\n", r"line 3, column 'b': 'nan' is not finite"),
    "decimal comma": ("a;b;y\n1,5;2;3\n" * 2, r"line 2, column 'a': '1,5' has a decimal comma"),
    "holes": ("a,b,y\n1,,3\n4,5,6\n7,8,nan\n", r"line 2, column 'b' is empty.* 2 of 3 lines have"),
    "one row": ("a,b,y\n1,2,3\n", r"it has 1 samples; at least 40"),
    "no header": ("1,2,3\n4,5,6\n", r"line 1 holds numbers only; .* comment right before it, must name"),
    "a comment is no header": ("# of today\n1,2,3\n4,5,6\n", r"line 2 holds numbers only"),
    "ragged": ("a,b,y\n1,2,3\n1,2\n", r"line 3 has 2 fields, but the header names 3"),
    "empty": ("\n \n", r"the file is empty"),
    "twice": ("a,a,y\n" + GOOD, r"two columns are called 'a'"),
    "nameless": ("a,,y\n" + GOOD, r"column 2 has no name"),
    "targets only": ("y1,y2,y3\n" + GOOD, r"all columns are targets"),
    "decimal comma in quotes": ('a,b,y\n1,"2,5",3\n', r"line 2, column 'b': '2,5' has a decimal comma"),
    "full width": ("a,b,y\n1,\uff11\uff12,3\n", r"line 2, column 'b': '\uff11\uff12' is no number"),
    "infinite": ("a,b,y\n1,-Infinity,3\n", r"line 2, column 'b': '-Infinity' is not finite"),
    "beyond float64": ("a,b,y\n1,1e999,3\n", r"line 2, column 'b': '1e999' is not finite"),
    "a comment too late": ("a,b,y\n1,2,3\n# gripper opens\n", r"line 3 has 1 fields"),
    "an open quote": ('a,b,y\n1,2,"3\n' + GOOD, r"line 52, column 'y': '3"),
    "one long field": (f"a,b,y\n1,2,3\n1,{'9' * 200_000},3\n", r"line 3: field larger than field limit"),
    "a long line": ("a,b,y\n" + "1," * 600_000, r"line 2 has more than 1048576 characters"),
    "nothing but lines": ("\n" * 2_000_000, r"the file is empty"),
    "wide": (",".join(f"a{i}" for i in range(100_000)) + "\n", r"100000 columns; at most 4096"),
    "spread over lines": ("a,b,y\n" + '"1\n",' * 300_000, r"in a quote that does not close"),
}

ROWS = [[0.5, -1e-3, 3.0], [2.0, 1e20, -4.0]]
SAME = {  # whoever writes them, these are a, b c, y and ROWS
    "sep": ("sep=;\na;b c;y\n0.5;-1e-3;3\n2;+1E20;-4.\n", ["a", "b c", "y"]),
    "sep in quotes": ('"SEP=\t"\r\na\tb c\ty\r\n.5\t-1e-3\t3\r\n2\t1e20\t-4\r\n', ["a", "b c", "y"]),
    "sep against the header": ("sep=;\na,1;b c,2;y\n0.5;-.001;3\n2;1e20;-4", ["a,1", "b c,2", "y"]),
    "blanks": ("  a , b c ,y  \n 0.5,\t-1e-3 , 3\n2 ,1e20, -4 \n", ["a", "b c", "y"]),
    "blank lines": ("\n\na,b c,y\n\n0.5,-1e-3,3\n  \n2,1e20,-4\n\n\n", ["a", "b c", "y"]),
    "comments": ("# one\n# two, three\na,b c,y\n0.5,-1e-3,3\n2,1e20,-4\n", ["a", "b c", "y"]),
    "the end of a line": ("a;b c;y;\n0.5;-1e-3;3;\n2;1e20;-4;\n", ["a", "b c", "y"]),
    "the end of some lines": ("a,b c,y\n0.5,-1e-3,3,\n2,1e20,-4\n", ["a", "b c", "y"]),
    "old Mac": ("a,b c,y\r0.5,-1e-3,3\r2,1e20,-4\r", ["a", "b c", "y"]),
    "commas in names": ('"p (x, y)";"b; c";y\n0.5;-1e-3;3\n2;1e20;-4\n', ["p (x, y)", "b; c", "y"]),
    "semicolons in names": ('"p (x; y; z)","b; c",y\n0.5,-1e-3,3\n2,1e20,-4\n', ["p (x; y; z)", "b; c", "y"]),
    "blanks before quotes": ('a, "b, c", "y"\n0.5, "-1e-3", 3\n2, 1e20 , -4\n', ["a", "b, c", "y"]),
    "quotes in quotes": ('"a ""1""",b,y\n0.5,-1e-3,3\n2,1e20,-4\n', ['a "1"', "b", "y"]),
    "lines in names": ('"a\n[m]",b c,y\n0.5,-1e-3,3\n2,1e20,-4\n', ["a\n[m]", "b c", "y"]),
    "lines of Unicode": ("a\u2028b,b\x0bc,y\n0.5,-1e-3,3\n2,1e20,-4\n", ["a\u2028b", "b\x0bc", "y"]),
    "blanks between": (" a  b   y \n 0.5  -1e-3   3\n  2.0   1e20  -4\n", ["a", "b", "y"]),
    "numpy.savetxt": ("# run 1\n# a b y\n0.5 -1e-3 3\n2.0 1e20 -4\n", ["a", "b", "y"]),
    "a header with #": ("# a, b c, y\n0.5,-1e-3,3\n2,1e20,-4\n", ["a", "b c", "y"]),
    "more commas than semicolons": ("a,1,2,3,4;b;y\n0.5;-1e-3;3\n2;1e20;-4\n", ["a,1,2,3,4", "b", "y"]),
}


@pytest.mark.parametrize("case", SAME)
def test_tables_are_read_whoever_wrote_them(case: str, tmp_path: Path) -> None:
    text, expected = SAME[case]
    (tmp_path / "a.csv").write_bytes(text.encode("utf-8-sig" if "#" in text else "utf-8"))
    names, read = open_table(tmp_path / "a.csv")
    assert list(names) == expected
    np.testing.assert_array_equal(read(names).values, ROWS)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16", "utf-16-be"])
def test_other_encodings_are_named_with_the_way_out(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("a,größe,y\n1,2,3\n".encode(encoding))
    with pytest.raises(DescriptionError, match=r"not UTF-8.*iconv -f LATIN1"):
        open_table(tmp_path / "a.csv")


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_told_by_line_and_column(case: str, tmp_path: Path) -> None:
    text, message = BROKEN[case]
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises(DescriptionError, match=message):
        load_table(path)


def test_parquet_is_csv(tmp_path: Path) -> None:
    values = table()
    columns = dict(zip("abcd", values.T, strict=True))
    parquet.write_table(pyarrow.table(columns), tmp_path / "good.parquet")
    names, read = open_table(tmp_path / "good.parquet")
    assert names == ("a", "b", "c", "d")
    np.testing.assert_array_equal(read("dbca").values, values[:, [3, 1, 2, 0]])
    holes = pyarrow.table({"a": [1.0, None], "y": [1.0, 2.0]})
    parquet.write_table(holes, tmp_path / "holes.parquet")
    with pytest.raises(DescriptionError, match="row 2, column 'a'"):
        load_table(tmp_path / "holes.parquet")
    parquet.write_table(pyarrow.table({"a": ["wood"], "y": [1.0]}), tmp_path / "text.parquet")
    with pytest.raises(DescriptionError, match="column 'a' holds string"):
        load_table(tmp_path / "text.parquet")
    (tmp_path / "fake.parquet").write_text("no")
    with pytest.raises(DescriptionError, match="no Parquet file"):
        load_table(tmp_path / "fake.parquet")


def test_a_damaged_parquet_is_not_read_as_if_whole(tmp_path: Path) -> None:
    values, path = table(), tmp_path / "a.parquet"
    columns = pyarrow.table(dict(zip("abcy", values.T, strict=True)))
    parquet.write_table(columns, path, write_page_checksum=True)
    whole, draw, refused = path.read_bytes(), np.random.default_rng(1), 0
    right = load_table(path)
    for place in draw.integers(4, len(whole) - 4, 80):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
        try:
            found = load_table(path)
        except DescriptionError:
            refused += 1
        else:
            torch.testing.assert_close(torch.cat([found.x, found.y], 1), torch.cat([right.x, right.y], 1))
    assert refused > 60
    lost = whole.replace(b"PAR1", b"PAR0", 1)[: len(whole) // 2]
    path.write_bytes(lost)
    with pytest.raises(DescriptionError, match="no Parquet file"):
        open_table(path)


def test_targets_are_named_or_found(tmp_path: Path) -> None:
    values = table()
    path = write(tmp_path / "a.csv", values, "a,b,c,load")
    with pytest.raises(DescriptionError, match=r"no column is called 'y'.*--targets.* are a, b, c, load"):
        load_table(path)
    assert load_table(path, ["a", "c"]).y.shape == (60, 2)
    assert load_table(write(tmp_path / "b.csv", values, "y1,a,y2,b")).y.shape == (60, 2)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_columns_that_are_not_asked_for_may_hold_anything(kind: str, tmp_path: Path) -> None:
    values, path = table(), tmp_path / f"a.{kind}"
    if kind == "csv":
        lines = [",".join(["monday", *map(repr, row), ""]) for row in values.tolist()]
        path.write_text("\n".join(["day,a,b,c,y,note", *lines]))
    else:
        columns = {"day": ["monday"] * 60, **dict(zip("abcy", values.T, strict=True)), "note": [None] * 60}
        parquet.write_table(pyarrow.table(columns), path)
    chosen = load_table(path, inputs=["c", "a"])
    given = stream_of(values[:, [2, 0]], values[:, 3:])
    torch.testing.assert_close(chosen.x, given.x)
    torch.testing.assert_close(chosen.y, given.y)
    with pytest.raises(DescriptionError, match="column 'day'"):
        load_table(path)
    with pytest.raises(DescriptionError, match="column 'y' cannot be both"):
        load_table(path, inputs=["a", "y"])
    with pytest.raises(UnknownNameError, match=r"torque.*day, a, b, c, y, note"):
        load_table(path, inputs=["torque"])


def test_y_is_measured_less_predicted_and_runs_stand_for_themselves(tmp_path: Path) -> None:
    values = np.column_stack([np.arange(60), table(), np.arange(60) // 10])
    path = write(tmp_path / "a.csv", values, ",a,b,said,seen,run")  # as pandas writes it, its index first
    stream = load_table(path, ["seen"], predicted=["said"], run="run")
    given = stream_of(values[:, 1:3], values[:, 4:5] - values[:, 3:4])
    torch.testing.assert_close(stream.x, given.x)
    torch.testing.assert_close(stream.y, given.y)
    assert stream.segments == (10,) * 6
    assert load_table(path, ["seen"], 35, predicted=["said"], run="run").segments == (10, 10, 10, 5)
    with pytest.raises(ParameterError, match=r"run = 'b' is not valid.*the same in all rows of a run"):
        load_table(path, ["seen"], predicted=["said"], run="b")
    with pytest.raises(ParameterError, match="one for each measured column"):
        load_table(path, ["seen", "a"], predicted=["said"])
    arguments = ["compare", "--data", str(path), "--predicted", "said", "--learners", "linear RLS"]
    whole = [*arguments, "--measured", "seen", "--run", "run", "--out", str(tmp_path / "out"), "--jobs", "1"]
    result = CliRunner().invoke(app, whole)
    assert result.exit_code == 0, result.output
    assert "in 6 parts" in " ".join(result.output.split())
    assert isinstance(CliRunner().invoke(app, arguments).exception, ParameterError)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_runs_may_have_names(tmp_path: Path, kind: str) -> None:
    names = [("left", "2", "left", "0")[i // 15] for i in range(60)]  # no text is another's number
    path = tmp_path / f"a.{kind}"

    def stream() -> Stream:
        if kind == "csv":
            lines = [f"{a!r},{y!r},{run}" for (a, _, _, y), run in zip(table().tolist(), names, strict=True)]
            path.write_text("\n".join(["a,y,run", *lines]))
        else:
            runs = pyarrow.array([name or None for name in names], pyarrow.large_string())
            parquet.write_table(pyarrow.table({"a": table()[:, 0], "y": table()[:, 3], "run": runs}), path)
        return load_table(path, run="run")

    assert stream().segments == (15,) * 4
    assert stream().x.shape == (60, 1)
    names[20] = ""
    with pytest.raises(DescriptionError, match=r"2\d?, column 'run'.* is empty"):
        stream()


def test_zero_is_the_model_for_a_residual_in_any_form(tmp_path: Path) -> None:
    values = table() + 5.0  # a model that is wrong by a constant
    path = write(
        tmp_path / "a.csv", np.column_stack([values, values[:, 3] + 1, np.ones(60)]), "a,b,c,y,seen,said"
    )
    inputs = ["a", "b", "c"]
    residual, pair = (
        load_table(path, inputs=inputs),
        load_table(path, "seen", inputs=inputs, predicted=["said"]),
    )
    torch.testing.assert_close(residual.y, pair.y)
    assert float(residual.y.mean()) > 3
    assert [one.about.split("; ")[1] for one in (residual, pair)] == ["alone: 0", "alone: said"]
    raw = load_table(path, "seen", inputs=inputs)
    assert abs(float(raw.y[:20].mean())) < 1e-9
    assert raw.about.endswith("alone: the mean of the first tenth")


def test_increments_are_not_mixed_with_targets(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", table())
    with pytest.raises(ParameterError, match="without targets and run"):
        load_recording(path, observation=["a"], targets=["y"], run="b")
    assert load_recording(path, observation=["a"], targets=[], run="").y.shape == (59, 1)


def test_a_clock_among_the_inputs_is_suspected(tmp_path: Path) -> None:
    run = np.arange(60) // 20
    values = np.column_stack([np.arange(60) % 20, table()[:, 1:], run])
    stream = load_table(write(tmp_path / "a.csv", values, "time,b,c,y,run"), run="run")
    assert "number of a row, to be left out: time." in compare(stream, ("linear RLS",)).verdicts()[0]
    assert not load_table(write(tmp_path / "b.csv", table())).notes
    nameless = load_table(write(tmp_path / "c.csv", values, "time,b,c,y,run")).notes  # runs without --run
    assert "number of a row, to be left out: time." in nameless
    assert "number of a run: run;" in nameless
    k, rest = np.arange(60), np.ones(60)
    wheel = np.column_stack([np.mod(0.7 * k, 6.3), k >= 30, rest, table()[:, 3]])
    assert not load_table(write(tmp_path / "d.csv", wheel, "angle,switch,load,y")).notes


def test_a_run_begins_a_sequence(tmp_path: Path) -> None:
    learned, begun = [], []

    class Watched(ZeroResidual):
        def absorb(self, x: torch.Tensor, y: torch.Tensor, mask: torch.Tensor | None) -> UpdateReport:
            learned.append(y)
            return super().absorb(x, y, mask)

        def new_sequence(self) -> None:
            begun.append(len(learned))

    path = write(tmp_path / "a.csv", np.column_stack([table(), np.arange(60) // 20]), "a,b,c,y,run")
    run_one(load_table(path, run="run"), Watched)
    assert begun == [20, 40]
    run_one(load_table(path), Watched)
    assert begun == [20, 40]


def test_rest_at_the_beginning_is_no_unit() -> None:
    moving = table(300)
    moving[:40] *= 1e-5
    stream = stream_of(moving[:, :3], moving[:, 3:], centre=True)
    assert max(float(stream.x.abs().max()), float(stream.y.abs().max())) < 6


def test_how_many_of_how_many_rows_were_used_is_told(tmp_path: Path) -> None:
    stream = load_table(write(tmp_path / "a.csv", table(60)), limit=50)
    assert stream.used == "the first 50 of 60 rows"
    report = compare(stream, ("default", "linear RLS"))
    assert "On the first 50 of 60 rows." in report.verdicts()[0]
    assert "default" in report.verdicts()[0]
    assert report.tables()[0].rows[0][0] in ("default", "default *")


def test_errors_of_each_output_are_given_in_the_units_of_the_file(tmp_path: Path) -> None:
    values = table() * [1.0, 1.0, 1e-3, 50.0]  # two predictions, and two measurements in other units
    values[:, 2:] += 4.0 * values[:, :2] * [1e-3, 50.0]
    path = write(tmp_path / "a.csv", np.column_stack([values, 0 * values[:, :2]]), "a,b,u,v,f,g")
    options = {"targets": ["u", "v"], "predicted": ["f", "g"], "inputs": ["a", "b"]}
    report = compare(path, ("linear RLS", "model alone"), **options)
    warm_up = report.streams[0].warm_up
    alone = np.sqrt(np.square(values[warm_up:, 2:]).mean(0))
    np.testing.assert_allclose(report.output_errors("a", "model alone"), alone, rtol=1e-12)
    learned = report.output_errors("a", "linear RLS")
    run = run_prequential(learner_factory("linear RLS")(2, 2), report.streams[0].x, report.streams[0].y)
    scored = run.mean.numpy()[warm_up:] * report.streams[0].unit - values[warm_up:, 2:]
    np.testing.assert_allclose(learned, np.sqrt(np.square(scored).mean(0)), rtol=1e-9)
    shown = report.tables()[-1]
    assert [row[0] for row in shown.rows] == ["u - f", "v - g"]
    np.testing.assert_allclose([row[2] for row in shown.rows], alone)
    with pytest.raises(ShapeError, match="2 of each"):
        dataclasses.replace(report.streams[0], outputs=("u",))
    values[30] *= 1e4  # a single row makes nearly all of the squared error
    path = write(tmp_path / "b.csv", np.column_stack([values, 0 * values[:, :2]]), "a,b,u,v,f,g")
    report = compare(path, ("model alone",), **options)
    medians = np.median(np.abs(values[warm_up:, 2:]), axis=0)
    assert report.measure("b") == "median"
    np.testing.assert_allclose(report.output_errors("b", "model alone"), medians, rtol=1e-12)
    assert report.tables()[-1].caption == "b: median errors in the units of the file"
    own = Columns(["a", "b"], ["u"], ["v"])
    assert load_own(path, own).stream().outputs == ("v",)


def test_units_come_from_the_warm_up_alone() -> None:
    values = table(300)
    changed = values.copy()
    changed[100:] *= 50.0
    one, two = (stream_of(v[:, :3], v[:, 3:], centre=True) for v in (values, changed))
    assert one.warm_up == 30
    torch.testing.assert_close(one.x[:100], two.x[:100], rtol=0, atol=0)
    torch.testing.assert_close(one.y[:100], two.y[:100], rtol=0, atol=0)
    assert float(one.x[:30].std(0, correction=0).sub(1).abs().max()) < 1e-12


def test_data_folder_must_be_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_EKM_DATA", str(tmp_path))
    with pytest.raises(DescriptionError, match="not there"):
        load_recording("t42")


def test_icub_grasp_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "icub_grasp" / "iCubGraspDataset"
    folder.mkdir(parents=True)
    for trial in (2, 1, 10):
        slices = []
        for t in range(20):
            slices += [" ".join([str(10.0 * t + trial)] * 9)]
            slices += [" ".join(["5.0"] * 5)] + [" ".join(["240"] * 12)] * 5
        (folder / f"book_{trial}.txt").write_text("-10000\n" + "\n".join(slices) + "\n")
    monkeypatch.setenv("TORCH_EKM_DATA", str(tmp_path))
    recording = load_recording("icub_grasp", limit=None)
    assert recording.segments == (18, 18, 18)
    assert recording.x.shape == (54, 23)
    torch.testing.assert_close(recording.y, torch.ones(54, 9, dtype=torch.float64))  # 10 deg a step, unit 10
    assert load_recording("icub_grasp", limit=20).used == "the first 36 of 54 rows"
    firsts = recording.x[::18, 0] * 30.0
    assert firsts.tolist() == pytest.approx([11.0, 12.0, 20.0])  # trials 1, 2, 10 in this order


def test_command_prints_and_writes_what_the_function_returns(tmp_path: Path) -> None:
    path, out = write(tmp_path / "mine.csv", table(80)), tmp_path / "out"
    arguments = ["compare", "--data", str(path), "--learners", "linear RLS,SOGP plain", "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, "--jobs", "1"])
    assert result.exit_code == 0, result.output
    for name in ("index.html", "scores.svg", "scores_mine.csv", "curve_mine.svg", "configuration.json"):
        assert (out / name).stat().st_size > 100, name
    direct = compare(path, ("linear RLS", "SOGP plain"))
    written = (out / "scores_mine.csv").read_text().splitlines()[1:]
    for line, score in zip(written, direct.row("mine"), strict=True):
        assert line.split(",")[1].strip('"').startswith(f"{score.rms.mean:.3f} [")


def test_sparse_online_gps_are_blue_whatever_they_are_called(tmp_path: Path) -> None:
    made = {"deep SOGP 5": learner_factory("SOGP plain"), "RLS": learner_factory("linear RLS")}
    found = compare(write(tmp_path / "a.csv", table()), made)
    lines = plot_scores(found).axes[0].lines[::2]
    drawn = {name: line.get_color() for name, line in zip(found.learners, lines, strict=False)}
    assert drawn["deep SOGP 5"] == COLOURS["E-KM"] != drawn["RLS"]


def test_a_simulated_hand_makes_a_stream() -> None:
    from torch_ekm.experiments.learner_comparison.simulated_stream import record_simulated_hand

    one = record_simulated_hand(12, seed=3)
    assert one.x.shape == (12, 26)
    assert one.y.shape == (12, 6)
    assert sum(one.segments) == 12
    assert len(one.segments) > 1  # grasped again
