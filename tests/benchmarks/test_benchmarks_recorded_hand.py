"""The benchmark on a recorded hand, on a synthetic recording of the same format."""

import math
import os
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import recorded_hand.benchmark
import torch
from recorded_hand.benchmark import predict_recorded_hand
from recorded_hand.fingers import FingerMarkers, PlanarFingers, identify_markers, register_camera
from recorded_hand.nominal import through_play
from recorded_hand.recordings import APART, UNIT, RecordedPath, read_recordings
from recorded_hand.report import write_report
from recorded_hand.synthetic import _CAMERA, _MARKERS, OBJECTS, write_synthetic

from torch_ekm.description import load_hand
from torch_ekm.exceptions import CalibrationError, DescriptionError, ParameterError, UnknownNameError
from torch_ekm.experiments.learner_comparison.recordings import load_t42

DATA = os.environ.get("TORCH_EKM_DATA", "")
STEPS = 200  # of a path; each reverses at least once


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four objects, two paths each, of the model's own making."""
    folder = tmp_path_factory.mktemp("recording")
    write_synthetic(folder, steps=STEPS)
    return folder


@pytest.fixture(scope="module")
def result(folder):
    return predict_recorded_hand(folder, learners=["linear RLS"], quick=True)


def ratio(result, name):
    """Five seconds ahead."""
    return next(row.ratio for row in result.rows if (row.name, row.horizon) == (name, 50))


def whole(paths, part):
    return np.concatenate([getattr(path, part) for path in paths])


def test_columns_are_fingers_whichever_hand_it_was(folder):
    """A left finger that closes pushes the object to the right; the red hand's columns are exchanged."""
    recordings = read_recordings(folder)
    assert set(recordings) == set(OBJECTS)
    file = np.load(folder / "t42_hand" / "t42_testpaths.npz")
    for name, paths in recordings.items():
        raw = file[f"{name}/0/A"]
        np.testing.assert_allclose(paths[0].delta_a, UNIT * (raw if "_red_" in name else raw[:, ::-1]))
        for path in paths:
            closing, along = np.cumsum(path.delta_a[:, 0]), path.pose[:, 0]
            assert np.corrcoef(closing, along)[0, 1] > 0.8
            assert np.isnan(path.markers[:, 3]).any()
            assert np.nanmax(np.abs(path.markers)) < 0.2  # [m]


def test_the_learners_stream_exchanges_them_too(folder, monkeypatch):
    monkeypatch.setenv("TORCH_EKM_DATA", str(folder))
    red = next(stream for stream in load_t42() if "_red_" in stream.name)
    # what the blue hand's Jacobian leaves of the red hand's motion is small only with its columns exchanged
    assert float(red.y[:, 0].square().mean().sqrt()) < 2.0


def test_markers_and_camera_are_found_where_they_were_put(folder):
    recordings = read_recordings(folder)
    apart = recordings[APART]
    markers = identify_markers(
        load_hand("yale_t42"), whole(apart, "markers"), whole(apart, "pose"), OBJECTS[APART]
    )
    found, placed = ([[r * math.cos(a), r * math.sin(a)] for r, a in of] for of in (markers.polar, _MARKERS))
    # 26 s of small motions tell a place to 2 mm, and the distal one across its link through the contact
    assert np.linalg.norm(np.subtract(found, placed), axis=1).max() < 3e-3
    assert 1e-4 < markers.noise < 4e-4
    red = register_camera(markers, whole(recordings["cyl35_red_d_v0"], "markers")[::10])
    np.testing.assert_allclose(red.camera[1:], _CAMERA["red"][1:], atol=3e-3)
    assert red.camera[0] == pytest.approx(_CAMERA["red"][0], abs=0.03)


def test_fingers_in_closed_form_agree_with_the_chain():
    """Markers of known joint angles are read back, and the gap to a cylinder is the detector's."""
    from recorded_hand.states import cylinder, upright
    from recorded_hand.synthetic import _marker_points

    from torch_ekm.contact import ContactDetector

    hand = load_hand("yale_t42")
    fingers = PlanarFingers(hand)
    q = np.random.default_rng(0).uniform([-0.5, 0.1, -0.5, 0.1], [0.3, 0.9, 0.3, 0.9], size=(20, 4))
    seen, off = fingers.read(_marker_points(hand, q), np.array(_MARKERS), np.zeros(3))
    np.testing.assert_allclose(seen, q, atol=1e-9)
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    position = np.tile([0.002, 0.09], (20, 1))
    detector = ContactDetector(hand, cylinder(0.03), margin=math.inf)
    at = torch.tensor([0.002, 0.09, 0.0], dtype=torch.float64)
    turn = upright(np.zeros(1))[0]
    gaps = [detector(torch.from_numpy(row), at, turn).gap.numpy() + 0.015 for row in q]
    np.testing.assert_allclose(fingers.distance(q, position), gaps, atol=1e-7)
    with pytest.raises(ParameterError, match="left_0"):
        PlanarFingers(load_hand("icub_right"))


def test_angles_say_how_sure_they_are_and_hidden_ones_are_left_to_their_range():
    from recorded_hand.synthetic import _marker_points

    hand, draw = load_hand("yale_t42"), np.random.default_rng(0)
    markers = FingerMarkers(PlanarFingers(hand), np.array(_MARKERS), np.zeros(3), 3e-4)
    q = draw.uniform([-0.5, 0.1, -0.5, 0.1], [0.3, 0.9, 0.3, 0.9], size=(400, 4))
    seen = _marker_points(hand, q) + 3e-4 * draw.standard_normal((400, 4, 2))
    found, std = markers.joints(seen)
    assert np.sqrt(np.square((found - q) / std).mean(0)) == pytest.approx(np.ones(4), abs=0.15)
    seen[0, 2] = np.nan  # of left_1
    hidden, spread = markers.joints(seen[:1])
    assert hidden[0, 2:].tolist() == found[0, 2:].tolist()
    assert hidden[0, 1] == pytest.approx((hand.joint_lower[1] + hand.joint_upper[1]) / 2)
    assert spread[0, 1] > 10 * std[0, 1]


def test_play_begins_at_its_closing_end():
    """+-0.02 rad: closing on passes at once, opening first goes through 0.04 rad."""
    closing = np.tile([0.001, -0.001], (60, 1))
    blank = np.zeros((60, 4, 2))
    path = RecordedPath(np.zeros((60, 3)), blank, np.zeros((60, 2)), closing)
    (moved,) = through_play([path], load_hand("yale_t42"))
    np.testing.assert_allclose(moved[:, 0], 0.001, atol=1e-15)
    np.testing.assert_allclose(np.cumsum(moved[:, 1])[[38, 59]], [0.0, -0.020], atol=1e-12)


def test_the_model_foresees_what_it_made(result):
    """Rigid, and with a diameter to be found: above all how objects of other diameters roll, and the play."""
    model = ratio(result, "KM, published figures, play")
    assert model["x"].mean < 0.2
    assert model["angle"].mean < 0.6 * ratio(result, "constant Jacobian, play")["angle"].mean
    assert ratio(result, "KM, published figures")["x"].mean > 3 * model["x"].mean
    assert ratio(result, "no model")["x"].mean == pytest.approx(1.0)
    states = result.states["poly6_d_v0"]
    assert states.found.mean() > 0.95
    assert np.median(states.diameter) == pytest.approx(OBJECTS["poly6_d_v0"], abs=3e-3)


def test_predictions_use_nothing_of_the_future(folder, result):
    """What comes after a moment may be anything: states and predictions up to it stay the same."""
    from recorded_hand.states import estimate_states

    hand, name = load_hand("yale_t42"), "poly6_d_v0"
    (path, *_) = read_recordings(folder)[name]
    cut = 121
    late = RecordedPath(path.pose.copy(), path.markers.copy(), path.loads, path.delta_a)
    late.pose[cut:] += 0.01
    late.markers[cut:] += 0.005
    was, now = (estimate_states(name, [one], result.markers, hand) for one in (path, late))
    before = was.step < cut
    np.testing.assert_array_equal(was.q[before], now.q[before])
    np.testing.assert_array_equal(was.contacts["point"][before], now.contacts["point"][before])
    assert not np.allclose(was.q[~before], now.q[~before])


def test_a_learner_sees_each_sample_after_its_prediction(result):
    """The first sample is the model's own; later ones differ; nothing is learned of the object set apart."""
    name = sorted(result.reported)[0]
    for nominal in ("no model", "KM, figures online, play"):
        alone, learned = (result.predicted[key, 50][name] for key in (nominal, f"{nominal} + linear RLS"))
        np.testing.assert_array_equal(learned[0], alone[0])
        assert not np.array_equal(learned[2:], alone[2:])
        assert APART not in result.predicted[f"{nominal} + linear RLS", 50]


def test_the_page_has_its_tables_and_pictures(result, tmp_path):
    report = write_report(result, tmp_path)
    assert (tmp_path / "index.html").stat().st_size > 5_000
    assert [figure.path for figure in report.figures] == ["scores.svg"]
    names = {table.name for table in report.tables}
    assert names == {"scores_10", "scores_50"}


def save(folder, key, states):
    arrays = {f"{key}/S": states, f"{key}/A": np.zeros((len(states), 2))}
    np.savez(folder / "t42_testpaths.npz", allow_pickle=False, **arrays)  # type: ignore[arg-type]


def test_what_is_wrong_is_told(tmp_path, folder):
    with pytest.raises(DescriptionError, match="t42_testpaths"):
        read_recordings(tmp_path)
    with pytest.raises(UnknownNameError, match="SOGP mixture"):
        predict_recorded_hand(folder, learners=["oracle"])
    save(tmp_path, "cyl30_d_v0/0", np.zeros((9, 13)))
    with pytest.raises(DescriptionError, match="cyl45_d_v0"):
        predict_recorded_hand(tmp_path)
    save(tmp_path, "a/0", np.zeros((9, 12)))
    with pytest.raises(DescriptionError, match=r"\(n, 13\)"):
        read_recordings(tmp_path)
    with pytest.raises(CalibrationError, match="20"):
        identify_markers(load_hand("yale_t42"), np.full((30, 4, 2), np.nan), np.zeros((30, 3)), 0.03)


def test_the_synthetic_recording_is_the_same_each_time(tmp_path):
    first, second = (np.load(write_synthetic(tmp_path / k, steps=20, paths=1)) for k in ("a", "b"))
    assert first.files == second.files
    for name in first.files:
        np.testing.assert_array_equal(first[name], second[name])


def test_command_line_runs_without_data(folder, result, tmp_path, monkeypatch, capsys):
    place, asked = str(Path(recorded_hand.benchmark.__file__).parent), []
    monkeypatch.setattr(recorded_hand.benchmark, "write_synthetic", lambda _: folder)
    predict = lambda *what, **how: asked.append((what, how)) or result  # noqa: E731
    monkeypatch.setattr(recorded_hand.benchmark, "predict_recorded_hand", predict)
    options = ["--quick", "--jobs", "1", "--learners", "linear RLS", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [place, *options])
    runpy.run_path(place, run_name="__main__")
    assert asked == [((None,), {"learners": ("linear RLS",), "processes": 1, "quick": True})]
    assert "KM, published figures" in capsys.readouterr().out
    assert (tmp_path / "index.html").stat().st_size > 5_000


@pytest.mark.skipif(
    not (Path(DATA) / "t42_hand").is_dir(), reason="TORCH_EKM_DATA holds no recordings of the T42"
)
def test_published_figures_foresee_a_real_object():
    """Five seconds ahead, two paths of three objects: far below a constant Jacobian in y."""
    result = predict_recorded_hand(DATA, learners=["model alone"], quick=True)
    published = ratio(result, "KM, published figures, play")
    constant = ratio(result, "constant Jacobian, play")
    assert published["x"].mean < 0.5
    assert published["y"].mean < 0.75 * constant["y"].mean
