"""DynamixelPlant: the genuine SDK against a bus of servos on a pseudo terminal."""

import math
import random
import re
import threading
import time
from pathlib import Path

import pytest
import torch
from dynamixel_bus import DynamixelBus
from motors import Motors
from wirings import DEG, radians, write

from torch_ekm.drivers import DynamixelPlant
from torch_ekm.exceptions import BusError, DescriptionError

TICK = 2 * math.pi / 4096


@pytest.fixture
def bus():
    with DynamixelBus([1, 2], Motors([1600.0, 2400.0], 4000.0)) as bus:
        yield bus


def open_at(bus: DynamixelBus, folder: Path, **changes: str) -> DynamixelPlant:
    return DynamixelPlant(write(folder, port=bus.port, **changes))


def test_a_motion_over_the_bus(bus, tmp_path) -> None:
    with open_at(bus, tmp_path, current="baud =|current_ma = 269\nbaud =") as plant:
        left, right = bus.tables[1], bus.tables[2]
        assert (left[11], left[64], left[98]) == (5, 1, 0)  # current-based position, torque, watchdog
        assert int.from_bytes(left[102:104], "little") == 100
        assert int.from_bytes(right[112:116], "little") == 146  # 200 deg/s in 0.229 rpm
        assert bus.goals[0] == [1600.0, 2400.0]  # torque comes on where it stands
        bus.tables[2][126:128] = (-50).to_bytes(2, "little", signed=True)
        seen = plant.reset(seed=0)
        torch.testing.assert_close(seen.a, TICK * radians(600.0, 600.0))
        assert seen.info["load"] == (0, -50)
        after = plant.command(radians(5 * DEG, -5 * DEG))
        torch.testing.assert_close(after.a, seen.a + radians(5 * DEG, -5 * DEG), atol=TICK / 2, rtol=0)
        plant.observe()  # a sync write has no answer: what comes after it has
        assert left[98] == 0  # at rest no watchdog
    assert not plant._port._handler.is_open


def test_a_servo_that_is_lost_is_named_with_its_line(bus, tmp_path) -> None:
    bus.silent.add(1)
    with pytest.raises(BusError, match=r"motor 'left', id 1 \(.*my_hand.toml:15\): no answer.*baud rate"):
        open_at(bus, tmp_path)
    bus.silent.clear()
    with pytest.raises(DescriptionError, match=r"my_hand.toml:7: .*'baud' 1234 is none"):
        open_at(bus, tmp_path, baud="1000000|1234")
    with pytest.raises(BusError, match="none-such"):
        DynamixelPlant(write(tmp_path, port="none-such"))


FAULTS = {
    "checksum": (lambda packet: packet[:-1] + bytes([packet[-1] ^ 1]), "checksum: noise, or two servos"),
    "wrong id": (lambda packet: _as(packet, 9), "servo 9 answers in its place"),
    "short": (lambda packet: _cut(packet), "too short or too long"),
    "half": (lambda packet: packet[: len(packet) // 2], "checksum|no answer"),
    "nothing": (lambda packet: b"", "no answer"),
    "noise": (lambda packet: bytes(random.Random(3).randbytes(40)), "checksum|no answer"),
}


def _signed(packet: bytes) -> bytes:
    from dynamixel_bus import checksum

    return packet + checksum(packet).to_bytes(2, "little")


def _as(packet: bytes, servo: int) -> bytes:
    return _signed(packet[:4] + bytes([servo]) + packet[5:-2])


def _cut(packet: bytes) -> bytes:
    size = int.from_bytes(packet[5:7], "little") - 3
    return _signed(packet[:5] + size.to_bytes(2, "little") + packet[7:-5])


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_the_bus_is_named_and_nothing_moves(name, bus, tmp_path) -> None:
    spoil, words = FAULTS[name]
    with open_at(bus, tmp_path) as plant:
        sent = len(bus.goals)
        bus.spoil = spoil
        for _ in range(5):  # on a busy machine an answer may also come too late
            with pytest.raises(BusError) as error:
                plant.command(radians(0.1, 0.1))
            if re.search(words, str(error.value)):
                break
            time.sleep(0.2)  # until late answers are there: the next command drops them
        assert re.search(words, str(error.value))
        assert len(bus.goals) == sent
        bus.spoil = lambda packet: packet


def test_a_packet_that_is_lost_is_asked_for_again(bus, tmp_path) -> None:
    with open_at(bus, tmp_path) as plant:
        lost = [True]
        bus.spoil = lambda packet: b"" if lost and lost.pop() else packet
        plant.observe()
        assert not lost


def test_an_answer_that_comes_late_is_passed_over(bus, tmp_path) -> None:
    """That of servo 2 to an earlier question, before that of servo 1."""
    with open_at(bus, tmp_path) as plant:
        late: list[bytes] = []
        bus.spoil = lambda packet: late.append(_as(packet, 2)) or packet
        at = plant.observe().a
        bus.spoil = lambda packet: late.pop(0) + packet if late else packet
        assert late
        asked, again = [], plant._port._again
        plant._port._again = lambda ask: asked.append(0) or again(ask)
        torch.testing.assert_close(plant.observe().a, at)
        assert len(asked) == 1, "and nothing is asked again"


def test_a_servo_that_has_switched_off_says_why(bus, tmp_path) -> None:
    with open_at(bus, tmp_path) as plant:
        bus.tables[2][70] = 0b100100
        with pytest.raises(
            BusError, match=r"motor 'right', id 2 .*:9\): overheated, overload: it has switched off"
        ):
            plant.observe()
        bus.tables[2][70] = 0


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        ("baud =|mode = 1\nbaud =", 7, "'mode' must be 3, 4 or 5 (positions), got 1"),
        ("baud =|current_ma = 6000\nbaud =", 7, "'current_ma' must be at most 3209.17, got 6000"),
        ("baud =|current_ma = 0\nbaud =", 7, "'current_ma' must be positive, got 0"),
        ("id = 1|id = 253", 17, "[[motors]] 'left': 'id' must be at most 252, got 253"),
        ("[limits]|[[joints]]\nname = 'left_0'\nid = 3\n[limits]", 20, "servos report no [[joints]]"),
    ],
)
def test_what_no_servo_has_is_named_before_anything_is_sent(change, line, words, bus, tmp_path) -> None:
    with pytest.raises(DescriptionError, match=rf"my_hand.toml:{line}: .*{re.escape(words)}"):
        open_at(bus, tmp_path, change=change)
    assert bus.goals == []
    assert bus.tables[1][11] == bus.tables[2][11] == 3


def test_two_servos_with_one_id(bus, tmp_path) -> None:
    """Both answer at once: bytes of one and of the other."""
    bus.spoil = lambda packet: packet[:6] + bytes(x ^ 0x14 for x in packet[6:]) if packet[4] == 1 else packet
    with pytest.raises(BusError, match=r"motor 'left', id 1.*two servos with one id"):
        open_at(bus, tmp_path)


def test_a_cable_that_is_pulled_is_a_typed_error(bus, tmp_path) -> None:
    plant = open_at(bus, tmp_path)
    bus.close()
    with pytest.raises(BusError, match=re.escape(bus.port)):
        plant.command(radians(0.1, 0.0))
    plant.close()


def test_a_watchdog_that_has_stopped_the_motors_is_cleared_by_the_next_driver(bus, tmp_path) -> None:
    bus.tables[1][98] = bus.tables[2][98] = 255  # the driver before was killed
    with open_at(bus, tmp_path) as plant:
        plant.command(radians(0.05, 0.0))


# -- what servos are -----------------------------------------------------------------------------------------

MODELS = {  # number: current for 350 mA, mode without one in the file
    1030: (130, 5), 1020: (130, 5), 1000: (130, 5), 1200: (350, 5), 1240: (350, 5), 1060: (None, 4),
}  # fmt: skip


def servos(model: int = 1030, at: float = 1600.0) -> DynamixelBus:
    return DynamixelBus([1, 2], Motors([at, 2400.0], 4000.0), model)


@pytest.mark.parametrize("model", MODELS)
def test_six_models_have_their_own_units_and_modes(model, tmp_path) -> None:
    register, mode = MODELS[model]
    with servos(model) as bus:
        if register is None:
            with pytest.raises(DescriptionError, match=r"toml:7: .*'current_ma' .* mode 4.*XL430-W250"):
                open_at(bus, tmp_path, current="baud =|current_ma = 350\nbaud =")
            with pytest.raises(DescriptionError, match=r"toml:7: .*'mode' must be 3 or 4 .*got 5.*XL430"):
                open_at(bus, tmp_path, mode="baud =|mode = 5\nbaud =")
        change = "baud =|baud =" if register is None else "baud =|current_ma = 350\nbaud ="
        with open_at(bus, tmp_path, change=change) as plant:
            assert bus.get(1, "mode") == mode
            assert register in (None, bus.get(1, "current"))
            seen = plant.reset(seed=0)
            after = plant.command(radians(0.05, -0.02))
            torch.testing.assert_close(after.a - seen.a, radians(0.05, -0.02), atol=TICK, rtol=0)


def test_a_model_that_nobody_knows_is_refused_by_name_and_line(tmp_path) -> None:
    with (
        servos(350) as bus,
        pytest.raises(BusError, match=r"'left'.*toml:15\): its model number 350 is none"),
    ):
        open_at(bus, tmp_path)
    assert bus.goals == []


def test_more_than_a_servo_allows_names_the_key_and_its_line(tmp_path) -> None:
    with servos(1240) as bus:
        bus.set(2, "current_limit", 300)
        words = r"toml:7: .*'current_ma' must be at most 300, got 350: motor 'right' is a servo XC330-M288"
        with pytest.raises(DescriptionError, match=words):
            open_at(bus, tmp_path, change="baud =|current_ma = 350\nbaud =")
        bus.set(1, "velocity_limit", 100)
        with pytest.raises(
            DescriptionError, match=r"toml:15: .*'left'.*Velocity Limit: write rate_deg = 137"
        ):
            open_at(bus, tmp_path)
        open_at(bus, tmp_path, change="rate_deg = 200|rate_deg = 137").close()


def test_in_mode_3_a_range_beyond_the_servos_limits_is_refused(tmp_path) -> None:
    """It would take no goal there, and say nothing."""
    mode = "baud =|mode = 3\nbaud ="
    with servos() as bus:
        bus.set(1, "max_position", 2000)
        words = r"toml:16: .*219 to 3173 ticks.* 0 and 2000: write range_deg = \[-68.6, 87.89\], or mode = 4"
        with pytest.raises(DescriptionError, match=words):
            open_at(bus, tmp_path, mode=mode)
        with open_at(bus, tmp_path, mode=mode, a="id = 1|id = 1\nrange_deg = [-68, 87]") as plant:
            plant.command(radians(0.34, 0.0))
            after = plant.command(radians(0.34, 0.0))  # to the end of the range
            torch.testing.assert_close(after.a[0], radians(87 * DEG)[0], atol=TICK, rtol=0)
        open_at(bus, tmp_path, mode="baud =|mode = 4\nbaud =").close()
        bus.set(1, "max_position", 100)
        with pytest.raises(DescriptionError, match=r"0 and 100: write mode = 4, or correct 'zero'"):
            open_at(bus, tmp_path, mode=mode)


def test_a_servo_that_obeys_another_ones_commands_is_refused(tmp_path) -> None:
    with servos() as bus:
        bus.set(2, "secondary", 1)
        with pytest.raises(DescriptionError, match=r"toml:11: .*'right': its Secondary ID is 1"):
            open_at(bus, tmp_path)
        bus.set(2, "secondary", 2)
        open_at(bus, tmp_path).close()


@pytest.mark.parametrize("name", ["pwm", "pwm_limit", "current", "current_limit"])
def test_a_servo_that_was_left_without_power_is_told_before_anything_moves(name, tmp_path) -> None:
    with servos() as bus:
        bus.set(1, "mode", 5)
        bus.set(1, name, 0)
        with pytest.raises(
            DescriptionError, match=r"toml:15: .*'left': its .* is 0, it cannot move: restore"
        ):
            open_at(bus, tmp_path)
        bus.set(1, name, 20)
        with open_at(bus, tmp_path) as plant:
            found = plant.notes[0]
        told = r"motor 'left': Goal (PWM is 2.26 % of 100 %|Current is 53.8 mA of 3209 mA), as another"
        assert name.endswith("limit") or re.match(told, found)


@pytest.mark.parametrize("turns", [-3, -1, 1])
def test_turns_that_a_power_cycle_has_taken_are_given_back(turns, tmp_path) -> None:
    with servos(at=1600.0 + 4096 * turns) as bus:
        with open_at(bus, tmp_path) as plant:
            seen = plant.reset(seed=0)
            torch.testing.assert_close(seen.a, TICK * radians(600.0, 600.0))
            after = plant.command(radians(0.05, 0.0))
            torch.testing.assert_close(after.a[0] - seen.a[0], radians(0.05)[0], atol=TICK, rtol=0)
        assert plant.notes[0].startswith("motor 'left': XM430-W210, firmware 46")
        assert f"has taken whole turns: 'zero' is now {1000 + 4096 * turns}" in plant.notes[0]
        bus.reboot(1)
        assert open_at(bus, tmp_path).reset(seed=0).a.tolist() == pytest.approx(after.a.tolist(), abs=1e-3)


def test_drive_mode_and_homing_offset_are_known(tmp_path) -> None:
    """Servo 1 counts the other way and from elsewhere; servo 2 takes the time of a motion, not a speed."""
    with servos() as bus:
        bus.set(1, "drive_mode", 1)
        bus.set(1, "homing", 5000)
        bus.set(2, "drive_mode", 4)
        wired = {"a": "id = 1\nzero = 1000|id = 1\nzero = 4000\nsign = -1"}
        with open_at(bus, tmp_path, **wired) as plant:
            assert "reverse Drive Mode" in plant.notes[0]
            assert "Homing Offset of 5000" in plant.notes[0]
            seen = plant.reset(seed=0)
            torch.testing.assert_close(seen.a, TICK * radians(600.0, 600.0))
            after = plant.command(radians(5 * DEG, -5 * DEG))
            torch.testing.assert_close(after.a - seen.a, radians(5 * DEG, -5 * DEG), atol=TICK, rtol=0)
            assert bus.get(1, "profile") == 146  # 0.229 rpm
            assert 20 <= bus.get(2, "profile") <= 30  # 5 deg at 200 deg/s [ms]


@pytest.mark.parametrize("level", [0, 1])
def test_servos_that_answer_little_are_told_to_answer(level, tmp_path) -> None:
    with servos() as bus:
        for servo in bus.ids:
            bus.set(servo, "level", level)
        with open_at(bus, tmp_path) as plant:
            plant.command(radians(0.05, 0.0))


def test_one_hand_has_one_master(bus, tmp_path) -> None:
    with open_at(bus, tmp_path), pytest.raises(BusError, match="another program or driver has it open"):
        open_at(bus, tmp_path)
    open_at(bus, tmp_path).close()


CHANGES = {
    "torque off": (lambda bus: bus.set(2, "torque", 0), r"id 2: torque is off \(Torque Enable 0, was 1"),
    "reboot": (lambda bus: bus.reboot(2), "'right', id 2: torque is off|'right': its clock .* rebooted"),
    "mode": (lambda bus: bus.set(1, "mode", 1), r"'left', id 1: its settings .*Operating Mode 1, was 5"),
    "limit": (lambda bus: bus.set(1, "current_limit", 9), "'left', id 1: its settings .*Current Limit 9"),
    "current": (lambda bus: bus.set(1, "current", 9), "'left', id 1: its settings .*Goal Current 9"),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_servo_that_is_not_what_it_was_ends_the_motion(name, bus, tmp_path) -> None:
    change, words = CHANGES[name]
    with open_at(bus, tmp_path) as plant:
        plant.command(radians(0.05, 0.05))
        time.sleep(0.2)
        change(bus)
        sent = []
        for _ in range(3):  # it stays an error until the driver is opened again
            with pytest.raises(BusError, match=words):
                plant.command(radians(0.05, 0.05))
            bus.catch_up()
            sent.append(len(bus.goals))
        assert sent[2] == sent[1]
    with open_at(bus, tmp_path) as plant:
        plant.command(radians(0.05, 0.05))


def test_a_servo_that_reboots_in_a_motion_ends_it(tmp_path) -> None:
    with DynamixelBus([1, 2], Motors([1600.0, 2400.0], 400.0)) as bus, open_at(bus, tmp_path) as plant:
        time.sleep(0.2)
        threading.Timer(0.1, bus.reboot, [2]).start()
        with pytest.raises(BusError, match=r"'right': its clock .* has rebooted|torque is off"):
            plant.command(radians(0.3, 0.3))
