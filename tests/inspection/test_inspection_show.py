"""A hand, a grasp and a log can be looked at; what is none of them is named."""

from __future__ import annotations

import html
import http.client
import urllib.parse
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.description import load_hand
from torch_ekm.exceptions import DescriptionError, OutputError, ParameterError, UnknownNameError
from torch_ekm.inspection.viewer.hand import GraspShow
from torch_ekm.inspection.viewer.serve import choose_show, save_page, serve
from torch_ekm.inspection.viewer.trial import LogShow
from torch_ekm.plant import RecordingPlant, Trajectory, TrialLog
from torch_ekm.rendering import make_scene
from torch_ekm.rendering.web import start_server
from torch_ekm.rendering.web_guard import WebGuard
from torch_ekm.simulation import SimulatedHand

viser = pytest.importorskip("viser")
pytest.importorskip("sapien")


ICUB = {"hand": "icub_right", "object": "box"}


class Control(SimpleNamespace):
    """What viser returns for a slider, a button, a text."""

    def on_click(self, function):
        self.click = function


class Gui:
    """Stands for viser's panel; ``controls`` by label."""

    def __init__(self):
        self.controls = {}

    def __getattr__(self, name):
        def add(label, *args, initial_value=None, **more):
            control = Control(value=initial_value, content=label, **more)
            self.controls[label if name != "add_html" else "note"] = control
            return control

        return add


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two trials of two commands each; the second is of a learner that never grasped."""
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


def test_sliders_close_the_free_hand():
    show, gui = choose_show("icub_right"), Gui()
    page = show.scene().transforms
    assert len(page) == 1 + 9 * 20  # each actuator there and back
    show.add_controls(gui)
    assert len(gui.controls) == 9
    assert show.update() is None
    gui.controls["index_distal [deg]"].value = 60.0
    moved = show.update()
    owners = [link.name for link in load_hand("icub_right").urdf.links for _ in link.collisions]
    way = np.linalg.norm(moved[:, :3, 3] - page[0][:, :3, 3], axis=1)
    index = np.array([name.startswith("index") for name in owners])
    assert way[index].max() > 0.01
    assert way[~index].max() < 1e-9
    assert show.update() is None


def test_a_grasp_follows_its_sliders_and_is_grasped_again():
    show, gui = GraspShow("icub_right", "box"), Gui()
    start = show.scene().transforms[0]
    show.add_controls(gui)
    assert "thumb" in gui.controls["note"].content
    assert show.update() is None
    gui.controls["index_distal [deg]"].value = 7.0
    frames = []
    while (moved := show.update()) is not None and len(frames) < 10:
        frames.append(moved)
    assert 2 <= len(frames) < 10  # at most 3 deg at a time, and then at rest
    turned = frames[-1][-1][:3, :3] @ start[-1][:3, :3].T
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) > 0.5
    gui.controls["Grasp again"].click(None)
    np.testing.assert_allclose(show.update(), start, atol=1e-12)
    assert gui.controls["index_distal [deg]"].value == 0.0


def test_a_log_is_played_from_command_to_command(folder):
    show, gui = LogShow(folder, trial=1), Gui()
    recording = TrialLog.open(folder).read(1)
    assert show.scene().transforms.shape[0] == 3
    for k, seen in enumerate(recording.observations):
        truth = seen.truth
        np.testing.assert_allclose(show.scene().transforms[k, -1, :3, 3], truth.position, atol=1e-12)
    show.add_controls(gui)
    gui.controls["play"].value = False
    assert show.update() is None
    gui.controls["command"].value = 2
    np.testing.assert_allclose(show.update(), show.scene().transforms[2])
    words = gui.controls["note"].content
    assert ", held, " in words
    assert "+1.7" in words  # 0.03 rad
    assert "ended: stalled" in words
    gui.controls["trial"].value = "0"
    assert show.update() is not None
    assert (show.trial, gui.controls["command"].value) == (0, 0)
    gui.controls["play"].value = True
    assert show.update() is not None
    assert gui.controls["command"].value == 1
    gui.controls["trial"].value = "2"
    assert show.update() is None
    assert "not grasped" in gui.controls["note"].content


def test_a_page_stands_alone(folder, tmp_path):
    page = save_page(LogShow(folder), tmp_path / "log.html").read_text(encoding="utf-8")
    assert len(page) > 500_000
    assert 'src="http' not in page
    with pytest.raises(OutputError, match="cannot be written"):
        save_page(LogShow(folder), tmp_path / "nowhere" / "log.html")


def test_served_it_answers_who_has_the_address(folder):
    connect = pytest.importorskip("websockets.sync.client").connect
    refused = pytest.importorskip("websockets.exceptions").InvalidStatus
    answers, turned_away = {}, []

    def ask(address):
        where = urllib.parse.urlsplit(address)
        secret, port = where.path.strip("/"), where.port
        assert where.hostname == "127.0.0.1"
        assert len(secret) >= 32

        def status(path, host=where.netloc):
            link = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            link.request("GET", path, headers={"Host": host})
            return link.getresponse().status

        answers["page"] = status(f"/{secret}/"), status(f"/{secret}/?darkMode")
        wrong = secret[:-1] + ("y" if secret.endswith("x") else "x")
        answers["no secret"] = status("/"), status("/index.html"), status(f"/{wrong}/"), status("//")
        answers["another name for this machine"] = status(f"/{secret}/", f"evil.example:{port}")
        version = [f"viser-v{viser.__version__}"]
        mine, theirs = f"http://127.0.0.1:{port}", "http://evil.example"
        options = {"subprotocols": version, "open_timeout": 120}
        with connect(f"ws://127.0.0.1:{port}/{secret}", origin=mine, **options) as socket:
            answers["socket"] = len(socket.recv(timeout=120)) > 0
        for path, origin in ((f"/{secret}", theirs), ("/", mine), (f"/{secret}", None), ("/", theirs)):
            with pytest.raises(refused, match="403"):
                connect(f"ws://127.0.0.1:{port}{path}", origin=origin, **options)
            turned_away.append(path)

    serve(choose_show(str(folder)), port=8931, on_ready=ask, stop=lambda: bool(turned_away))
    assert answers["page"] == (200, 200)
    assert answers["no secret"] == (403,) * 4
    assert answers["another name for this machine"] == 403
    assert answers["socket"]
    assert len(turned_away) == 4


def test_a_server_that_cannot_be_guarded_is_not_started(monkeypatch):
    monkeypatch.setattr(WebGuard, "_before", lambda self, process_request: process_request)
    with pytest.raises(ParameterError, match="viser"):
        start_server()


def test_no_text_of_a_log_becomes_a_part_of_the_page(folder, tmp_path):
    """What viser's Markdown would have run."""
    script = "<iframe srcdoc='<script>parent.alert(1)</script>'></iframe> [x](javascript:alert(1)) **bold**"
    recording = TrialLog.open(folder).read(0)
    recording.observations[0].info["events"] = (script,)
    recording.about["outcome"]["reason"] = script
    recording.observations = recording.observations[:1]
    recording.commands = []
    show, gui = LogShow(recording.save(tmp_path / "trial.h5")), Gui()
    show.add_controls(gui)
    words = gui.controls["note"].content
    assert f"event: {html.escape(script)}" in words
    assert f"ended: {html.escape(script)}" in words
    assert "<iframe" not in words
    page = save_page(show, tmp_path / "log.html").read_text(encoding="utf-8")
    assert "<iframe srcdoc" not in page


def test_what_cannot_be_shown_is_named(folder, tmp_path):
    with pytest.raises(UnknownNameError, match=r"icub_right.*a log's folder"):
        choose_show("nonsense")
    with pytest.raises(ParameterError, match="left out with a log"):
        choose_show(str(folder), object="box")
    with pytest.raises(DescriptionError, match="nothing to show: not grasped"):
        LogShow(folder, trial=2)
    with pytest.raises(DescriptionError, match="no trial 7; there are 0, 1, 2"):
        LogShow(folder, trial=7)
    with pytest.raises(DescriptionError, match="no such log"):
        LogShow(tmp_path / "none")
    with pytest.raises(DescriptionError, match="name its folder"):
        LogShow(folder / "trial_000001.h5", trial=1)
    assert LogShow(folder / "trial_000001.h5").trial == 1
    recording = TrialLog.open(folder).read(0)
    for configuration, match in (
        ({"hand": "icub_right"}, "no object"),
        ({"hand": "icub_right", "object": "box"}, "4 joints"),
    ):
        path = Trajectory(
            0, recording.commands, recording.observations, {"configuration": configuration}
        ).save(tmp_path / "trial.h5")
        with pytest.raises(DescriptionError, match=match):
            LogShow(path)


def test_a_scene_without_an_object_is_the_hand_alone():
    hand, q = load_hand("planar_two_finger"), np.zeros((2, 4))
    scene = make_scene(hand, None, q, None, None, np.array([0, -9.81, 0]))
    assert len(scene.shapes) == sum(len(link.collisions) for link in hand.urdf.links)


def test_command_line(folder, tmp_path):
    runner = CliRunner()
    page = tmp_path / "page.html"
    done = runner.invoke(app, ["replay", str(folder), "--trial", "1", "--html", str(page)])
    assert done.exit_code == 0, done.output
    assert "stalled" in done.output
    assert page.stat().st_size > 500_000
    page.unlink()
    done = runner.invoke(app, ["show", "planar_two_finger", "--object", "box", "--html", str(page)])
    assert done.exit_code == 0, done.output
    assert page.exists()
    page.unlink()
    done = runner.invoke(app, ["show", "yale_t42", "--object", "cylinder_45mm", "--html", str(page)])
    assert done.exit_code == 0, done.output
    assert page.exists()
    failed = runner.invoke(app, ["replay", str(tmp_path / "nothing")])
    assert isinstance(failed.exception, DescriptionError)
    made = tmp_path / "made"
    arguments = ["record", str(made), "--seeds", "0:1", "--preset", "none", "--no-sensing", "--angles", "3"]
    done = runner.invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert TrialLog.open(made).index[0].reason == "reached"
    assert "1 reached" in done.output.replace("\n", " ")
    failed = runner.invoke(app, [*arguments[:-1], "x,3"])
    assert isinstance(failed.exception, ParameterError)
    assert "x,3" in str(failed.exception)
