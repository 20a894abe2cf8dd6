"""Files as their owners have them: rounded inertias, slides, classes with meshes, robots with a hand."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.description import HandDescription, load_hand, load_object, write_template
from torch_ekm.description.mimic import unheld_joints
from torch_ekm.description.urdf import inertia_problem, read_urdf
from torch_ekm.exceptions import DescriptionError
from torch_ekm.kinematics import HandKinematics

LIMIT = '<limit lower="0" upper="1.5" effort="1" velocity="1"/>'
FINGER = """<robot name="a"><link name="palm"/>
  <joint name="near" type="revolute"><parent link="palm"/><child link="near"/>{limit}</joint>
  <link name="near">{inertial}</link></robot>"""
INERTIAL = """<inertial><origin rpy="0.3 0 0.7"/>{mass}
  <inertia ixx="{}" ixy="0" ixz="0" iyy="{}" iyz="0" izz="{}"/></inertial>"""
MASS = '<mass value="0.02"/>'


@pytest.mark.parametrize(
    ("inertial", "principal"),
    [
        (INERTIAL.format(1e-6, 2e-7, 0, mass=MASS), [4.005e-7, 5.995e-7, 1e-6]),
        (INERTIAL.format(1.49e-6, 2e-7, 8.3e-7, mass=MASS), [4.3e-7, 1.06e-6, 1.49e-6]),
        (INERTIAL.format(1e-6, 1e-6, 0, mass=MASS), [1e-9, 1e-6, 1e-6]),
        (INERTIAL.format(0, 0, 0, mass=MASS), [2e-7] * 3),
        (INERTIAL.format(1e-6, 1e-6, 1e-6, mass=""), [0, 0, 0]),
        (f"<inertial>{MASS}</inertial>", [2e-7] * 3),
    ],
    ids=["rounded to zero", "rounded", "rod", "zeros", "no mass", "mass alone"],
)
def test_inertias_that_no_body_has_are_mended(inertial: str, principal: list[float], tmp_path: Path) -> None:
    """Their largest and their axes stay; an object's, which matters, is refused."""
    path = tmp_path / "a.urdf"
    path.write_text(FINGER.format(limit=LIMIT, inertial=inertial))
    urdf = read_urdf(path)
    link = urdf.link("near")
    assert link.mass == 0 or not inertia_problem(link.mass, link.inertia)
    np.testing.assert_allclose(np.linalg.eigvalsh(link.inertia), principal, rtol=1e-9, atol=1e-20)
    (note,) = urdf.notes
    assert note == "inertias of no solid body (zero, rounded) are mended for the simulator: near"
    box = load_object("box").urdf_path
    old = box.read_text()
    before, after = old[: old.index("<inertial>")], old[old.index("</inertial>") + 11 :]
    (tmp_path / "b.urdf").write_text(before + inertial + after)
    (tmp_path / "b.object.toml").write_text(box.with_suffix(".object.toml").read_text())
    with pytest.raises(DescriptionError, match=r"'box'.*(no solid body|positive mass)"):
        load_object(tmp_path / "b.urdf")


@pytest.mark.parametrize(
    ("limit", "note"),
    [
        ('<limit lower="0" upper="90"/>', "limits beyond a whole turn, in rad; are they in deg?: near"),
        ('<limit effort="1"/>', "equal limits lock joints: near"),
    ],
)
def test_limits_that_may_be_meant_otherwise_are_named(limit: str, note: str, tmp_path: Path) -> None:
    """And a joint that is held may have its figures."""
    slide = '<joint name="rail" type="prismatic"><parent link="base"/><child link="palm"/></joint>'
    text = FINGER.format(limit=limit, inertial="").replace("</robot>", slide + '<link name="base"/></robot>')
    (tmp_path / "a.urdf").write_text(text)
    (tmp_path / "a.transmission.toml").write_text("""[hand]
name = "a"
[joints]
rail = { spring = 0.0 }
near = { spring = 0.1 }
[[actuators]]
name = "m"
range = [0, 1]
moment_arms = { near = 1.0 }
""")
    assert load_hand(tmp_path / "a.urdf").notes[-1] == note


# an arm of one joint and one slide, a leg, and a hand of two joints, one of which is tied to the arm's
ROBOT = f"""<robot name="robot"><link name="base"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="column"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint><link name="column"/>
  <joint name="wrist" type="revolute"><parent link="column"/><child link="palm"/><axis xyz="0.6 0 0.8"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/>{LIMIT}</joint><link name="palm"/>
  <joint name="near" type="revolute"><parent link="palm"/><child link="near"/><axis xyz="0 1 0"/>
    <origin xyz="0.02 0 0.01" rpy="0 0 0.2"/>{LIMIT}</joint><link name="near"/>
  <joint name="far" type="revolute"><parent link="near"/><child link="far"/><axis xyz="1 0 0"/>
    <origin xyz="0 0 0.04"/>{LIMIT}<mimic joint="wrist" multiplier="2" offset="0.1"/></joint>
  <link name="far"/>
  <joint name="knee" type="revolute"><parent link="base"/><child link="shin"/>{LIMIT}</joint>
  <link name="shin"/></robot>"""
OF_THE_HAND = """
[hand]
name = "a"
base_link = "palm"
[joints]
near = { spring = 0.05 }
far = { rest = 0.1 }
[[couplings]]
name = "far"
joints = { far = 1 }
[[actuators]]
name = "m"
range = [0, 1.5]
moment_arms = { near = 1.0 }
"""


def robot(folder: Path, transmission: str = "", text: str = ROBOT) -> Path:
    path = folder / "robot.urdf"
    path.write_text(text)
    if transmission:
        (folder / "robot.transmission.toml").write_text(transmission)
    return path


def test_a_base_link_cuts_the_hand_out_of_a_robot(tmp_path: Path) -> None:
    hand = load_hand(robot(tmp_path, OF_THE_HAND))
    assert (hand.joint_names, hand.link_names) == (("near", "far"), ("palm", "near", "far"))
    assert [note.partition(":")[0] for note in hand.notes] == [
        "the hand is what 'palm' carries; 2 joints elsewhere are left out",
        "'far' is a <mimic> of 'wrist', which is left out",
        "joints that slide or float are held at 0",
    ]
    # the whole robot, of which the wrist stands anywhere
    every = OF_THE_HAND.replace('base_link = "palm"', "").replace(
        "[joints]", "[joints]\nwrist = {}\nknee = {}"
    )
    every += "[[actuators]]\nname = 'w'\nrange = [0, 1]\nmoment_arms = { wrist = 1 }\n"
    every += "[[actuators]]\nname = 'k'\nrange = [0, 1]\nmoment_arms = { knee = 1 }\n"
    (tmp_path / "all").mkdir()
    whole = load_hand(robot(tmp_path / "all", every))
    assert whole.joint_names == ("wrist", "near", "far", "knee")
    q = torch.tensor([0.7, 0.4, 0.3, 0.2], dtype=torch.float64)
    there, here = HandKinematics(whole)(q), HandKinematics(hand)(q[1:3])
    for link in hand.link_names:
        expected = torch.linalg.inv(there.of("palm")) @ there.of(link)
        torch.testing.assert_close(here.of(link), expected, atol=1e-12, rtol=0)


def test_joints_of_the_rest_of_a_robot_may_be_named(tmp_path: Path) -> None:
    named = OF_THE_HAND.replace("[joints]", "[joints]\nwrist = { spring = 0.05 }")
    assert load_hand(robot(tmp_path, named)).joint_names == ("near", "far")
    robot(tmp_path, named.replace("wrist =", "wirst ="))
    with pytest.raises(DescriptionError, match="wirst"):
        load_hand(tmp_path / "robot.urdf")


def test_a_fixed_base_keeps_the_joints_that_the_file_names(tmp_path: Path) -> None:
    fixed = ROBOT.replace('name="wrist" type="revolute"', 'name="wrist" type="fixed"').replace(
        'joint="wrist"', 'joint="near"'
    )
    assert load_hand(robot(tmp_path, OF_THE_HAND, fixed)).urdf.root == "palm"
    robot(tmp_path, OF_THE_HAND.replace("[joints]", "[joints]\nknee = { spring = 1 }"), fixed)
    hand = load_hand(tmp_path / "robot.urdf")
    assert (hand.joint_names, hand.urdf.root, hand.base_link) == (("near", "far", "knee"), "base", "palm")


def test_a_base_link_may_be_a_frame_of_the_palm(tmp_path: Path) -> None:
    """One that carries nothing: the hand is what the palm carries, in that frame."""
    frame = '<link name="frame"/><joint name="f" type="fixed"><parent link="palm"/><child link="frame"/>'
    text = ROBOT.replace("</robot>", frame + '<origin xyz="0.01 0.02 0.03"/></joint></robot>')
    hand = load_hand(robot(tmp_path, OF_THE_HAND.replace('"palm"', '"frame"'), text))
    assert (hand.joint_names, hand.urdf.root, hand.base_link) == (("near", "far"), "palm", "frame")
    palm = HandKinematics(hand)(torch.zeros(2, dtype=torch.float64)).of("palm")
    torch.testing.assert_close(palm[:3, 3], torch.tensor([-0.01, -0.02, -0.03], dtype=torch.float64))


def test_a_template_asks_for_the_hand_alone(tmp_path: Path) -> None:
    path = robot(tmp_path)
    done = CliRunner().invoke(app, ["hands", "--new", str(path), "--base", "palm"])
    assert done.exit_code == 0, done.output
    assert "Assumed:   the hand is what 'palm' carries" in done.output
    text = (tmp_path / "robot.transmission.toml").read_text()
    assert 'base_link = "palm"' in text
    assert "knee" not in text
    assert 'name = "far is locked"' in text
    with pytest.raises(DescriptionError, match="unknown base_link 'plam'; links are: base"):
        write_template(path, "plam")


def test_all_joints_that_nothing_holds_are_named() -> None:
    """However little they move against each other."""
    rows, springs = np.array([[1.0, 100.0, 0.0, 0.0]]), np.diag([0.0, 0.0, 0.2, 0.0])
    assert unheld_joints("abcd", rows, springs) == ["a", "b", "d"]
    assert unheld_joints("ab", np.zeros((0, 2)), np.eye(2)) == []


# -- MJCF -------------------------------------------------------------------------------------------

MESHES = """
<mujoco model="a">
  <option collision="all" gravity="0 0 -9.81"/>
  <default>
    <default class="ball"><geom mesh="knuckle"/><default class="inner"/></default>
    <default class="seen"><geom type="mesh" contype="0" conaffinity="0"/>
      <default class="knuckle"><geom mesh="knuckle"/></default>
      <default class="pad"><geom type="box" size="0.001 0.002 0.003" contype="1"/></default>
    </default>
  </default>
  <asset><mesh name="knuckle" file="gone.stl"/></asset>
  <worldbody>
    <body name="near" pos="0 0 0.02" childclass="knuckle">
      <joint name="near" axis="0 1 0" range="0 90" stiffness="0.1"/>
      <geom/><geom class="inner"/><geom class="pad"/><geom class="seen" mesh="knuckle"/>
      <geom class="seen" type="capsule" size="0.006" fromto="0 0 0 0 0 0.04" contype="1"/>
      <body name="far" childclass="pad"><geom pos="0 0 0.01"/></body>
    </body>
  </worldbody>
  <actuator><position name="m" joint="near" kp="4" ctrlrange="0 1.5"/></actuator>
</mujoco>
"""


def read(folder: Path, text: str, name: str = "hand.xml") -> HandDescription:
    (folder / name).write_text(text)
    return load_hand(folder / name)


def test_a_mesh_that_a_class_names_is_left_out(tmp_path: Path) -> None:
    hand = read(tmp_path, MESHES, "hand.mjcf")
    assert [shape.kind for shape in hand.urdf.link("near").collisions] == ["box", "capsule"]
    assert [shape.size for shape in hand.urdf.link("far").collisions] == [(0.002, 0.004, 0.006)]
    assert hand.notes == ("links whose meshes are not read, and touch nothing: near",)


# a hand with its own motors on a carriage, beside a thing and a lamp that nobody moves
CARRIED = """
<mujoco model="carried">
  <include file="../scene.xml"/>
  <compiler angle="radian" settotalmass="2"/>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="thing">
      <joint type="slide" axis="1 0 0"/><joint name="spin" axis="0 0 1"/><geom size="0.02"/>
    </body>
    <body name="arm" pos="0.1 0.2 0.3" euler="0.2 0.3 0.4">
      <joint name="rail" type="slide" axis="1 0 0" ref="0.05"/>
      <joint name="elbow" axis="0 1 0" range="-1 1" ref="0.1"/><geom size="0.01"/>
      <body name="palm" pos="0 0 0.2" euler="0.5 0 0.6">
        <joint name="wrist" axis="1 0 0" range="-1 1"/><geom type="ellipsoid" size="0.01 0.02 0.03"/>
        <body name="finger" pos="0.03 0 0">
          <joint name="near" axis="0 1 0" range="0 1.5" stiffness="0.1"/><geom name="finger" size="0.01"/>
          <body name="tip" pos="0 0 0.04">
            <joint name="far" axis="0 1 0" range="0 1.5" stiffness="0.1"/><geom name="tip" size="0.01"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="flexor"><joint joint="near" coef="0.01"/><joint joint="far" coef="0.005"/>
      <joint joint="rail" coef="1"/></fixed>
  </tendon>
  <equality><weld body1="thing"/></equality>
  <actuator>
    <position name="rail" joint="rail" kp="100" ctrlrange="0 1"/>
    <position name="elbow" joint="elbow" kp="100" ctrlrange="-1 1"/>
    <position name="wrist" joint="wrist" kp="100"/>
    <position name="pull" tendon="flexor" kp="4000" ctrlrange="0.05 0.07" forcerange="0 50"/>
  </actuator>
</mujoco>
"""


def test_carrying_slides_are_held_and_things_left_out(tmp_path: Path) -> None:
    hand = read(tmp_path, CARRIED)
    assert hand.joint_names == ("elbow", "wrist", "near", "far")
    assert hand.actuator_names == ("elbow", "wrist", "pull")
    assert hand.notes == (
        "files outside the folder are not read: ../scene.xml",
        "hands have hinges; joints of other kinds are held: rail",
        "these move and nothing drives them: they are left out: thing",
        "shapes other than box, sphere, capsule and cylinder touch nothing, those of: palm",
        "actuators that drive no joint of the hand are left out: rail",
        "these count in the length of their tendon, not in rad; plants and models count in its largest arm: "
        "pull",
    )


# a four-bar on a carriage: its rod and a spring's tendon are the hand's, a rod on a ball joint is held
HELD = """
<mujoco model="held">
  <compiler angle="radian"/>
  <worldbody>
    <body name="palm">
      <joint name="rail" type="slide" axis="1 0 0" ref="0.05"/><geom size="0.01"/>
      <body name="crank"><joint name="crank" axis="0 1 0" range="-1 1" stiffness="0.1"/><geom size="0.01"/>
        <body name="rod" pos="0 0 0.03"><joint name="rod" axis="0 1 0" range="-1 1"/><geom size="0.01"/>
        </body>
        <body name="ball" pos="0 0 0.03"><joint name="ball" type="ball"/><geom size="0.01"/></body>
      </body>
      <body name="finger" pos="0.05 0 0">
        <joint name="finger" axis="0 1 0" range="-1 1"/><geom size="0.01"/>
        <body name="far"><joint name="far" axis="0 1 0" range="-1 1"/><geom size="0.01"/></body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="spring" stiffness="100" springlength="0.07">
      <joint joint="crank" coef="0.01"/><joint joint="rail" coef="1"/>
    </fixed>
  </tendon>
  <equality>
    <connect name="four_bar" body1="rod" body2="finger" anchor="0.05 0 0"/>
    <connect name="by_ball" body1="ball" body2="finger" anchor="0.05 0 0"/>
    <connect name="carriage" body1="palm" body2="world" anchor="0 0 0"/>
    <joint name="to_rail" joint1="far" joint2="rail" polycoef="0.2 1 3 0 0"/>
  </equality>
  <actuator><position name="pull" joint="crank" kp="5" ctrlrange="0 1"/></actuator>
</mujoco>
"""


def test_loops_and_springs_of_a_hand_with_held_joints(tmp_path: Path) -> None:
    """What is held stays where MuJoCo starts it, in loops, in couplings and in springs."""
    hand = read(tmp_path, HELD)
    assert hand.joint_names == ("crank", "rod", "finger", "far")
    assert hand.loops.names == ("four_bar", "four_bar")
    np.testing.assert_array_equal(hand.coupling, [[0, 0, 0, 1]])
    np.testing.assert_allclose(hand.spring_rest, [0, 0, 0, 0.2])
    np.testing.assert_allclose(hand.tendon_springs.low, [0.02])
    assert hand.notes == (
        "hands have hinges; joints of other kinds are held: rail, ball",
        "loops that close through joints that are held are left out: by_ball",
    )
    template = write_template(tmp_path / "hand.xml").read_text()
    assert 'spring = "TODO"' not in template  # the loop holds what has no spring
    assert "slack = [0.0" in template


def test_the_mass_that_a_file_sets_is_the_hands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the things'; without MuJoCo's complaint in a file."""
    monkeypatch.chdir(tmp_path)
    hand = read(tmp_path, CARRIED.replace('settotalmass="2"', ""))
    shares = [link.mass for link in hand.urdf.links]
    for link, share in zip(read(tmp_path, CARRIED).urdf.links, shares, strict=True):
        assert link.mass == pytest.approx(2 * share / (sum(shares) + 1000 * 4 / 3 * np.pi * 0.02**3))
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_base_link_cuts_a_hand_out_of_an_mjcf(tmp_path: Path) -> None:
    """Poses and gravity in its frame are MuJoCo's, the arm at its zero angles."""
    (tmp_path / "hand.xml").write_text(CARRIED)
    written = write_template(tmp_path / "hand.xml", "palm")
    text = written.read_text()
    assert "elbow" not in text
    assert "pull" in text
    written.write_text(text.partition("[[pads]]")[0])
    hand = load_hand(tmp_path / "hand.xml")
    assert (hand.joint_names, hand.actuator_names, hand.base_link) == (("near", "far"), ("pull",), "palm")
    model = mujoco.MjModel.from_xml_string(CARRIED.replace('<include file="../scene.xml"/>', ""))
    data = mujoco.MjData(model)
    q = {"near": 0.4, "far": 0.7, "elbow": 0.0}
    for name, angle in q.items():
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(model, data)
    R, at = data.body("palm").xmat.reshape(3, 3), data.body("palm").xpos
    poses = HandKinematics(hand)(torch.tensor([0.4, 0.7], dtype=torch.float64))
    for link in ("finger", "tip"):
        there = R.T @ (data.geom(link).xpos - at)
        shape = hand.urdf.link(link).collisions[0].transform
        np.testing.assert_allclose((poses.of(link).numpy() @ shape)[:3, 3], there, atol=1e-12)
    np.testing.assert_allclose(hand.gravity, R.T @ [0, 0, -9.81], atol=1e-12)


def test_motors_without_range_or_at_all_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "hand.xml"
    path.write_text(MESHES.replace(' range="0 90"', "").replace(' ctrlrange="0 1.5"', ""))
    with pytest.raises(DescriptionError, match=r"still to be filled in.*actuators\[m\]\.range"):
        load_hand(path)
    start, end = MESHES.index("<actuator>"), MESHES.index("</mujoco>")
    path.write_text(MESHES[:start] + MESHES[end:])
    text = write_template(path).read_text()
    assert 'moment_arms = { near = "TODO" }' in text


def test_a_tendon_that_ties_joints_with_motors_of_their_own_is_left_out(tmp_path: Path) -> None:
    """Both motors of the Adroit hand's coupled joints."""
    tied = CARRIED.replace(
        "<tendon>",
        '<tendon><fixed name="tie" limited="true" range="-.001 .001">'
        '<joint joint="near" coef="1"/><joint joint="far" coef="-1"/></fixed>',
    )
    assert len(read(tmp_path, tied).coupling) == 1
    motors = '<position name="{0}" joint="{0}" kp="1" ctrlrange="0 1"/>'
    hand = read(tmp_path, tied.replace("<actuator>", "<actuator>" + motors.format("far")))
    assert (hand.n_a, len(hand.coupling)) == (4, 0)
    assert "tendons that tie joints with motors of their own are left out: tie" in hand.notes
