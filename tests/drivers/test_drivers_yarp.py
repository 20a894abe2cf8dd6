"""YarpPlant: the text carrier, against the bytes of a genuine network, and against a genuine one."""

import random
import time
from pathlib import Path

import pytest
import torch
from spoiling import Spoiler
from wirings import DEG, of_page, write
from yarp_golden import GoldenYarp

from torch_ekm.description import load_hand
from torch_ekm.drivers import YarpPlant
from torch_ekm.exceptions import BusError, DescriptionError, DeviceError

ICUB = load_hand("icub_right")


def wiring(folder: Path, port: int, extra: str = "", bus: str = "") -> Path:
    text = (
        '[hand]\ndriver = "yarp"\ndescription = "icub_right"\n[bus]\n'
        f'name_server = "127.0.0.1:{port}"\npart = "/icub/right_arm"\n{bus}'
        "[limits]\nstill_for = 0.02\nrate_deg = 150\ntimeout = 0.5\n"
    )
    for k, name in enumerate(ICUB.actuator_names):
        text += f'[[motors]]\nname = "{name}"\nid = {7 + k}\n'
    path = folder / "icub.toml"
    path.write_text(text + extra)
    return path


HALL = '[[joints]]\nname = "index_1"\nid = 3\nsign = -1\nzero = 255\nper_rad = 162.3\n'
ANALOG = 'analog = "/icub/right_hand/analog:o"\n'


@pytest.fixture
def yarp():
    network = GoldenYarp()
    yield network
    network.close()


def increment(**moves: float) -> torch.Tensor:
    delta = torch.zeros(ICUB.n_a, dtype=torch.float64)
    for name, value in moves.items():
        delta[ICUB.actuator_names.index(name)] = value
    return delta


def test_axes_7_to_15_are_the_hand_and_the_arm_is_left_alone(yarp, tmp_path) -> None:
    with YarpPlant(wiring(tmp_path, yarp.server, HALL, ANALOG)) as plant:
        assert yarp.commands[:2] == ["[set] [icmd] [cmod] 7 [pos]", "[set] [vel] 7 150"]
        seen = plant.reset(seed=0)
        torch.testing.assert_close(seen.a, torch.full((9,), 45 * DEG, dtype=torch.float64))
        at = ICUB.joint_names.index("index_1")
        assert float(seen.q[at]) == pytest.approx((255 - 131) / 162.3, abs=0.02)  # count 3 of the stream
        after = plant.command(increment(thumb_distal=4 * DEG))
        moved = after.a - seen.a
        torch.testing.assert_close(moved, increment(thumb_distal=4 * DEG), atol=1e-6, rtol=0)
        assert after.taken.joints > seen.time
    axes = {int(text.split()[2]) for text in yarp.commands if "[pos]" in text and "cmod" not in text}
    assert axes == set(range(7, 16))


def test_the_file_of_the_how_to_moves_an_icub(yarp, tmp_path) -> None:
    text = of_page("yarp").replace("icub-head:10000", f"127.0.0.1:{yarp.server}")
    with YarpPlant(write(tmp_path, text)) as plant:
        seen = plant.reset(seed=0)
        delta = increment(index_distal=2 * DEG)
        torch.testing.assert_close(plant.command(delta).a - seen.a, delta, atol=1e-6, rtol=0)
    assert [text for text in yarp.commands if "[pos] 12 " in text]


def test_a_port_that_is_not_there_is_named(yarp, tmp_path) -> None:
    path = wiring(tmp_path, yarp.server)
    path.write_text(path.read_text().replace("right_arm", "left_arm"))
    with pytest.raises(BusError, match=r"/icub/left_arm/rpc:i: the name server has no such port"):
        YarpPlant(path)
    with pytest.raises(BusError, match=r"name server at 127.0.0.1:9: ConnectionRefusedError"):
        YarpPlant(wiring(tmp_path, 9))
    path = wiring(tmp_path, 9)
    path.write_text(path.read_text().replace("127.0.0.1:9", "localhost"))
    with pytest.raises(DescriptionError, match=r"icub.toml:5: .*host:port"):
        YarpPlant(path)
    path.write_text(wiring(tmp_path, 9).read_text().replace("127.0.0.1:9", "icub..head:10000"))
    with pytest.raises(BusError, match=r"name server at icub\.\.head"):
        YarpPlant(path)
    with pytest.raises(DescriptionError, match="'analog' is missing"):
        YarpPlant(wiring(tmp_path, yarp.server, HALL))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"[fail]\r\n", "answers"),
        (b"[is] encs (1.0 nan) [ok]\r\n", "no numbers"),
        (b"[is] encs (1.0 2.0) 1.5 [ok]\r\n", "has 2 axes, .*needs 16|answers"),
        (b"[is] encs (1.0\r\n", "answers"),
        (b"", "TimeoutError"),
    ],
)
def test_answers_that_cannot_be_right_are_typed_errors(answer, words, yarp, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torch_ekm.drivers.yarp._TIMEOUT", 0.2)
    plant = YarpPlant(wiring(tmp_path, yarp.server))
    yarp.spoil = lambda data: answer
    sent = len(yarp.commands)
    with pytest.raises(BusError, match=words):
        plant.command(increment(thumb_distal=0.1))
    assert len(yarp.commands) == sent
    yarp.spoil = lambda data: data
    plant.observe()  # connected again where it must be
    plant.close()


def test_a_cable_that_is_pulled_is_a_typed_error(yarp, tmp_path) -> None:
    plant = YarpPlant(wiring(tmp_path, yarp.server, HALL, ANALOG))
    plant.observe()
    yarp.close()
    with pytest.raises(BusError, match="YARP port"):
        plant.command(increment(thumb_distal=0.1))
    plant.close()


def test_garbled_messages_send_no_axis_beyond_its_limits(yarp, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("torch_ekm.drivers.yarp._TIMEOUT", 0.3)
    draw = random.Random(1)
    plant, failed, moved = YarpPlant(wiring(tmp_path, yarp.server, HALL, ANALOG)), 0, 0
    yarp.spoil = Spoiler(0.05, seed=1)
    for _ in range(25):
        while yarp.motors.moving:
            time.sleep(0.005)
        at, sent = yarp.motors.now(), len(yarp.commands)
        try:
            plant.command(increment(thumb_distal=draw.uniform(-0.03, 0.03)))
            moved += 1
        except DeviceError:
            failed += 1
        for text in yarp.commands[sent:]:
            words = text.split()
            if words[1] == "[pos]":
                goal, axis = float(words[3]), int(words[2]) - 7
                lower, upper = ICUB.actuator_lower[axis] / DEG, ICUB.actuator_upper[axis] / DEG
                assert lower - 1e-6 <= goal <= upper + 1e-6
                assert abs(goal - at[axis]) < 20.0
    assert failed
    assert moved
    yarp.spoil = lambda data: data
    plant.close()


def look(plant: YarpPlant) -> None:
    for _ in range(20):
        plant.observe()
        time.sleep(0.01)


def test_a_stream_that_broke_is_opened_again(yarp, tmp_path) -> None:
    with YarpPlant(wiring(tmp_path, yarp.server, HALL, ANALOG)) as plant:
        plant.observe()
        yarp.hang_up()
        with pytest.raises(DeviceError):
            look(plant)
        yarp.hall = 100.0
        time.sleep(0.5)
        seen = plant.observe()
        at = ICUB.joint_names.index("index_1")
        assert float(seen.q[at]) == pytest.approx((255 - 103) / 162.3, abs=0.02)


def test_an_axis_that_has_left_position_control_ends_the_motion(yarp, tmp_path) -> None:
    with YarpPlant(wiring(tmp_path, yarp.server)) as plant:
        plant.command(increment(thumb_distal=0.02))
        yarp.modes[10] = "[hwf]"
        sent = len(yarp.commands)
        problem = "motor 'thumb_distal', axis 10 of /icub/right_arm: its control mode is hwf"
        with pytest.raises(BusError, match=problem):
            plant.command(increment(index_distal=0.02))
        assert len(yarp.commands) == sent
    with pytest.raises(BusError, match="refuses"):
        YarpPlant(wiring(tmp_path, yarp.server))
    yarp.modes.clear()
    YarpPlant(wiring(tmp_path, yarp.server)).close()


def test_one_hand_has_one_master(yarp, tmp_path) -> None:
    path = wiring(tmp_path, yarp.server)
    with YarpPlant(path), pytest.raises(BusError, match=r"/icub/right_arm of .*one hand has one master"):
        YarpPlant(path)
    YarpPlant(path).close()
