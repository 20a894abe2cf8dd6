"""A hand, a grasp and a log can be looked at; what is none of them is named."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.description import load_hand
from torch_ekm.exceptions import DescriptionError, OutputError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.inspection.view import view, view_hand, view_log
from torch_ekm.plant import RecordingPlant, Trajectory, TrialLog
from torch_ekm.rendering import Captions, save_animation
from torch_ekm.simulation import SimulatedHand


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two trials of two commands each; the third is of a learner that never grasped."""
    folder = tmp_path_factory.mktemp("log")
    log = TrialLog(folder, {"hand": "planar_two_finger", "object": "box", "gravity": [0, -9.81, 0]})
    plant = RecordingPlant(SimulatedHand("planar_two_finger", "box"))
    for trial in range(2):
        plant.reset(trial)
        for step in (0.03, 0.03):
            plant.command(torch.tensor([step, -step]))
        log.write(trial, plant.trajectory, {"reason": "stalled"})
    log.write(2, Trajectory(9), {"reason": "not grasped"})
    return folder


def test_each_actuator_of_a_hand_closes_and_opens() -> None:
    hand = load_hand("icub_right")
    page = view_hand(hand).scene.transforms
    assert len(page) == 1 + 9 * 20
    index = hand.actuator_names.index("index_distal")
    closed = page[1 + 20 * index + 9]
    owners = [link.name for link in hand.urdf.links for _ in link.collisions]
    way = np.linalg.norm(closed[:, :3, 3] - page[0][:, :3, 3], axis=1)
    own = np.array([name.startswith("index") for name in owners])
    assert way[own].max() > 0.01
    assert way[~own].max() < 1e-9
    np.testing.assert_allclose(page[20 * (index + 1)], page[0], atol=1e-12)


def test_a_grasp_says_what_each_actuator_does() -> None:
    seen = view("planar_two_finger", "box")
    hand = load_hand("planar_two_finger")
    assert [row[0] for row in seen.rows] == ["at rest", *hand.actuator_names]
    assert seen.rows[0][1:3] == ("0.0", "0.0")
    assert all(float(row[2]) > 0.1 for row in seen.rows[1:])  # [mm]
    frames = seen.scene.transforms
    assert len(frames) == 1 + 4 * hand.n_a
    np.testing.assert_allclose(frames[4], frames[0])  # the same grasp for each
    turned = frames[2][-1][:3, :3] @ frames[0][-1][:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    one, other = (float(row[1]) for row in seen.rows[1:])
    assert abs(angle - abs(one)) < 0.06
    assert one * other < 0  # fingers that oppose each other turn it either way


def test_the_reach_goes_to_both_ends_and_home() -> None:
    seen = view("planar_two_finger", "can", reach=True)
    (*back, first), (*forth, last) = ([r for r in seen.rows if r[0] == name] for name in ("back", "forth"))
    assert all(len(way) > 3 for way in (back, forth))  # waypoints with their bands
    assert {row[3] for row in (*back, *forth)} == {"", "not safe"}
    assert [end[3] for end in (first, last)] == ["actuator: left", "actuator: right"]
    np.testing.assert_allclose(seen.scene.transforms[0], seen.scene.transforms[-1])
    with pytest.raises(ParameterError, match="without an object"):
        view("icub_right", reach=True)


def test_a_log_is_played_from_command_to_command(folder) -> None:
    seen = view_log(folder, trial=1)
    recording = TrialLog.open(folder).read(1)
    assert len(seen.scene.transforms) == len(seen.rows) == 3
    for k, one in enumerate(recording.observations):
        np.testing.assert_allclose(seen.scene.transforms[k, -1, :3, 3], one.truth.position, atol=1e-12)
    assert seen.rows[0][1:3] == ("held", "0.0")
    assert "+1.7" in seen.rows[1][4]  # 0.03 rad


def test_a_page_stands_alone_and_has_no_text_of_the_log(folder, tmp_path) -> None:
    script = "<iframe srcdoc='<script>parent.alert(1)</script>'></iframe>"
    recording = TrialLog.open(folder).read(0)
    recording.observations[0].info["events"] = (script,)
    seen = view_log(recording.save(tmp_path / "trial.h5"))
    assert script in seen.rows[0][-1]
    seen = replace(seen, captions=replace(seen.captions, title=script, lines=(script,) * len(seen.rows)))
    page = save_animation(seen.scene, tmp_path / "log.html", seen.captions).read_text(encoding="utf-8")
    assert "http" not in page
    assert "<iframe" not in page
    assert page.count("</script>") == 2
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    assert data["title"] == script  # as text
    with pytest.raises(OutputError, match="cannot be written"):
        save_animation(seen.scene, tmp_path / "nowhere" / "log.html")


def test_a_page_tells_what_moves_how_far_and_with_what_force() -> None:
    seen = view("planar_two_finger", "box")
    captions, frames = seen.captions, len(seen.scene.transforms)
    assert captions.title == "planar_two_finger holds box"
    assert captions.lines[:3] == ("at rest", "motor left +2.5 deg", "motor left +5.0 deg")
    assert captions.turned[2] == pytest.approx(float(seen.rows[1][1]), abs=0.06)
    assert captions.forces.shape == (frames, 2, 6)
    sizes = np.linalg.norm(captions.forces[0, :, 3:], axis=-1)
    said = [float(part.split()[-1]) for part in seen.rows[0][3].split(", ")]
    np.testing.assert_allclose(sizes, said, atol=0.06)
    hand = load_hand("planar_two_finger")
    for k, pad in enumerate(hand.pads):  # where the pad is, and away from its link
        place = captions.forces[0, k, :3]
        assert 0 < np.linalg.norm(place) < 0.2, pad.name
    # both press towards the object between them
    assert captions.forces[0, 0, 3:] @ captions.forces[0, 1, 3:] < 0
    way = captions.forces[0, 1, :3] - captions.forces[0, 0, :3]
    assert captions.forces[0, 0, 3:] @ way > 0
    reach = view("planar_two_finger", "can", reach=True).captions
    assert len(reach.std) == len(reach.turned) == len(reach.lines)
    assert reach.std.max() > 0.1
    assert any("not safe" in line for line in reach.lines)


def test_what_a_page_tells_is_of_its_frames(folder, tmp_path) -> None:
    scene = view_log(folder).scene
    with pytest.raises(ShapeError, match="lines"):
        save_animation(scene, tmp_path / "page.html", Captions(lines=("one",)))
    with pytest.raises(ShapeError, match="turned"):
        save_animation(scene, tmp_path / "page.html", Captions(turned=np.zeros(2)))


def test_what_cannot_be_shown_is_named(folder, tmp_path) -> None:
    with pytest.raises(UnknownNameError, match="icub_right"):
        view("nonsense")
    for path, trial, said in (
        (folder, 2, "nothing to show: not grasped"),
        (folder, 7, "no trial 7; there are 0, 1, 2"),
        (tmp_path / "none", None, "no such log"),
        (folder / "trial_000001.h5", 1, "name its folder"),
    ):
        with pytest.raises(DescriptionError, match=said):
            view_log(path, trial=trial)
    recording = TrialLog.open(folder).read(0)
    for configuration, match in (
        ({"hand": "icub_right"}, "no object"),
        ({"hand": "icub_right", "object": "box"}, "4 joints"),
    ):
        log = Trajectory(0, recording.commands, recording.observations, {"configuration": configuration})
        path = log.save(tmp_path / "trial.h5")
        with pytest.raises(DescriptionError, match=match):
            view_log(path)


def test_command_line(folder, tmp_path) -> None:
    runner = CliRunner()
    page = tmp_path / "page.html"
    done = runner.invoke(app, ["replay", str(folder), "--trial", "1", "--html", str(page)])
    assert done.exit_code == 0, done.output
    assert "stalled" in done.output
    assert "held" in done.output
    assert "planar_two_finger holds box: trial_000001" in page.read_text(encoding="utf-8")
    page.unlink()
    done = runner.invoke(app, ["show", "yale_t42", "--object", "cylinder_45mm", "--html", str(page)])
    assert done.exit_code == 0, done.output
    assert page.exists()
    failed = runner.invoke(app, ["replay", str(tmp_path / "nothing")])
    assert isinstance(failed.exception, DescriptionError)
