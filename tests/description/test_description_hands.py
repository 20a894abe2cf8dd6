"""The hands that come with the package: counts, figures, consistency of URDF and transmission."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from own_files import change, copied

from torch_ekm.description import list_hands, load_hand, load_object, registry
from torch_ekm.description.registry import urdf_folder
from torch_ekm.exceptions import DescriptionError, EKMError, UnknownNameError
from torch_ekm.kinematics import HandKinematics

FINGERS = ("thumb", "index", "middle", "ring", "little")


@pytest.mark.parametrize("name", list_hands())
def test_every_hand_loads_and_is_consistent(name: str) -> None:
    hand = load_hand(name)
    assert hand.name == name
    assert load_hand(hand.urdf_path).joint_names == hand.joint_names  # by path, as a user's own
    assert hand.actuation_jacobian.shape == (hand.n_a, hand.n_q)
    assert np.linalg.matrix_rank(np.vstack([hand.actuation_jacobian, hand.coupling])) == hand.n_a + len(
        hand.coupling
    )
    assert (hand.joint_lower <= hand.joint_upper).all()
    assert (hand.actuator_lower < hand.actuator_upper).all()
    assert {pad.link for pad in hand.pads} <= set(hand.link_names)
    # rest is a posture the couplings allow, and springs hold every joint
    np.testing.assert_allclose(hand.coupling @ hand.spring_rest, 0.0, atol=1e-12)
    assert (hand.spring_stiffness > 0).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_icub_is_the_hand_of_the_paper(side: str) -> None:
    hand = load_hand(f"icub_{side}")
    assert hand.joint_names == tuple(f"{finger}_{k}" for finger in FINGERS for k in range(4))
    assert hand.n_q == 20
    assert hand.n_a == 9
    assert set(hand.link_names) == {"hand", *hand.joint_names, *(f"{finger}_tip" for finger in FINGERS)}
    limits_deg = {"thumb_0": (10, 90), "index_0": (0, 20), "middle_0": (0, 0), "middle_1": (0, 90)}
    for joint, (lower, upper) in limits_deg.items():
        k = hand.joint_names.index(joint)
        assert math.degrees(hand.joint_lower[k]) == pytest.approx(lower, abs=1e-9)
        assert math.degrees(hand.joint_upper[k]) == pytest.approx(upper, abs=1e-9)


def test_icub_actuators() -> None:
    """Their moment arms: tests/kinematics, against the public coupling."""
    hand = load_hand("icub_right")
    np.testing.assert_allclose(np.degrees(hand.actuator_upper), [60, 90, 90, 180, 90, 180, 90, 180, 270])
    np.testing.assert_allclose(np.degrees(hand.actuator_offset), [60, 0, 0, 0, 0, 0, 0, 0, 0])
    tendons = [actuator.name for actuator in hand.actuators if actuator.tendon]
    assert tendons == ["thumb_distal", "index_distal", "middle_distal", "pinky"]


def test_icub_hall_sensors() -> None:
    hand = load_hand("icub_right")
    expected = [f"{finger}_{k}" for finger in FINGERS for k in (1, 2, 3)]
    assert [(sensor.joint, sensor.channel) for sensor in hand.hall_sensors] == [
        (j, k) for k, j in enumerate(expected)
    ]
    assert all((sensor.open, sensor.closed) == (255.0, 0.0) for sensor in hand.hall_sensors)


@pytest.mark.parametrize("side", ["right", "left"])
def test_icub_weighs_what_its_cad_says(side: str) -> None:
    """0.2483 kg, centre of mass (9.1, -6.9, -11.2) mm with straight fingers.

    Source: icub-models, iCubGenova02, link r_hand. The shares of palm and fingers
    were derived from it, so a few mm is what they can be asked for.
    """
    hand = load_hand(f"icub_{side}")
    poses = HandKinematics(hand)(torch.zeros(20, dtype=torch.float64))
    mass = sum(link.mass for link in hand.urdf.links)
    com = sum(link.mass * (poses.of(link.name).numpy() @ [*link.com, 1.0])[:3] for link in hand.urdf.links)
    assert mass == pytest.approx(0.2483, abs=1e-3)
    mirror = 1.0 if side == "right" else -1.0
    np.testing.assert_allclose(com / mass, [0.0091, -0.0069 * mirror, -0.0112], atol=0.003)
    for link in hand.urdf.links:
        if link.mass > 0:  # a rigid body's principal inertias obey the triangle inequality
            a, b, c = np.linalg.eigvalsh(link.inertia)
            assert a + b > c > 0


@pytest.mark.parametrize("name", list_hands())
def test_pads_lie_on_collision_shapes(name: str) -> None:
    """The detector (pads) and a simulator (URDF collisions) must see the same surface."""
    hand = load_hand(name)
    for pad in hand.pads:
        (capsule,) = hand.urdf.link(pad.link).collisions
        assert capsule.kind == "capsule"
        radius, length = capsule.size
        assert radius == pad.radius
        half = capsule.transform[:3, 2] * length / 2
        ends = [capsule.transform[:3, 3] - half, capsule.transform[:3, 3] + half]
        np.testing.assert_allclose(ends[1], pad.end, atol=1e-9)
        if pad.start != pad.end:
            np.testing.assert_allclose(ends[0], pad.start, atol=1e-9)


def test_gravity_is_the_files(tmp_path: Path) -> None:
    assert {load_hand(name).gravity for name in list_hands()} == {(0.0, 0.0, 9.81)}
    urdf, transmission = copied(tmp_path)
    line = "gravity = [0.0, 0.0, 9.81]"
    change(transmission, line, "gravity = [0, -9.8, 0]")
    assert load_hand(urdf).gravity == (0.0, -9.8, 0.0)
    change(transmission, "gravity = [0, -9.8, 0]", "")
    assert load_hand(urdf).gravity == (0.0, 0.0, 9.81)
    urdf, transmission = copied(tmp_path)
    change(transmission, line, "gravity = [0.0, nan, 0.0]")
    with pytest.raises(DescriptionError, match="gravity"):
        load_hand(urdf)


def test_unknown_names_list_the_right_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"icub_right, icub_left, planar_two_finger.*\.urdf") as caught:
        load_hand("shadow")
    assert caught.value.name == "shadow"
    with pytest.raises(EKMError, match="no such URDF file"):
        load_hand("somewhere/else.urdf")
    with pytest.raises(UnknownNameError, match=r"\.urdf or \.xml"):
        load_hand("hand.json")
    with pytest.raises(UnknownNameError, match="toothpaste, applier, box, weighted_box, bottle, can"):
        load_object("banana")


def test_files_are_what_the_generator_writes() -> None:
    """Nobody edits the written files by hand; the figures live in one place."""
    script = urdf_folder() / "generate.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_data_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a wheel the files lie in torch_ekm/_urdf; without any, the error says what is wrong."""
    package = tmp_path / "torch_ekm" / "description"
    (package.parent / "_urdf" / "objects").mkdir(parents=True)
    monkeypatch.setattr(registry, "__file__", str(package / "registry.py"))
    assert urdf_folder() == package.parent / "_urdf"
    (package.parent / "_urdf" / "objects").rmdir()
    with pytest.raises(DescriptionError, match="not installed"):
        urdf_folder()


def test_the_t42_has_its_published_figures() -> None:
    """Straight fingers: pads face each other, their flats 52 - 2 * 11.95 mm apart, tips 110.475 mm out."""
    hand = load_hand("yale_t42")
    assert hand.planar_normal == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(hand.actuation_jacobian, np.kron(np.eye(2), [[8 / 10.5] * 2]), atol=1e-6)
    np.testing.assert_allclose(hand.actuator_backlash, 0.04)
    np.testing.assert_allclose(hand.spring_stiffness[1::2] / hand.spring_stiffness[::2], 2.0)
    poses = HandKinematics(hand)(torch.zeros(4, dtype=torch.float64))
    flat = [
        (poses.of(pad.link).numpy() @ [*(np.array(pad.end) + pad.radius * np.array(pad.direction)), 1])[:3]
        for pad in hand.pads
    ]
    np.testing.assert_allclose(flat[1] - flat[0], [0.052 - 2 * 0.01195, 0, 0], atol=1e-12)
    tips = [poses.of(f"{finger}_tip").numpy()[:3, 3] for finger in ("left", "right")]
    np.testing.assert_allclose(
        tips, [[-0.026, 0.0625 + 0.047975, 0], [0.026, 0.0625 + 0.047975, 0]], atol=1e-9
    )
