"""Hands from MJCF: the tree and the transmission that MuJoCo itself has."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from torch_ekm.description import ContactPad, HandDescription, load_hand, write_template, write_transmission
from torch_ekm.description.registry import file_digests
from torch_ekm.exceptions import DescriptionError
from torch_ekm.inspection.check import _to_paste, check_hand
from torch_ekm.kinematics import HandKinematics
from torch_ekm.rendering.visuals import visuals

# two fingers in our own words: anchors off the body's origin, a reference angle, two joints in one body, a
# fixed tendon, a joint that follows another, and a tendon under an equality
FINGERS = """
<mujoco model="two fingers">
  <compiler angle="degree" meshdir="/nowhere"/>
  <option gravity="0 0 -9.81"/>
  <default>
    <joint range="-10 90" limited="true" stiffness="0.05" springref="5" frictionloss="0.002"
           damping="0.02" armature="1e-4"/>
    <geom type="capsule" size="0.008"/>
    <default class="drawn"><geom type="mesh" contype="0" conaffinity="0"/></default>
  </default>
  <asset><mesh name="shell" file="shell.stl"/></asset>
  <worldbody>
    <light pos="0 0 1"/>
    <body name="palm" pos="0.1 0.2 0.3" euler="20 -30 40">
      <inertial mass="0.5" pos="0.01 0 0" diaginertia="1e-4 2e-4 2e-4"/>
      <geom class="drawn" mesh="shell"/>
      <body name="first" pos="0.02 0 0" euler="0 0 15">
        <joint name="f0" axis="0 1 0" pos="0 0 -0.004" ref="10"/>
        <joint name="f1" axis="1 0 0" pos="0.003 0 0"/>
        <geom name="first" fromto="0 0 0 0 0 0.03"/>
        <body name="tip" pos="0 0 0.035">
          <joint name="f2" axis="0 1 0"/>
          <geom name="tip" fromto="0 0 0 0.004 0 0.02"/>
          <body name="nail" pos="0 0 0.02"><geom name="nail" type="box" size="0.004 0.004 0.001"/></body>
        </body>
      </body>
      <body name="thumb" pos="-0.03 0 0">
        <joint name="t0" axis="0 -1 0" ref="4"/>
        <geom name="thumb" fromto="0 0 0 0 0 0.03"/>
        <body name="thumb_tip" pos="0 0 0.03">
          <joint name="t1" axis="0 -1 0" stiffness="0"/>
          <joint name="t2" axis="1 0 0" stiffness="0"/>
          <geom name="thumb_tip" type="sphere"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="1 0 0"><freejoint/><geom type="sphere" size="0.02"/></body>
  </worldbody>
  <tendon>
    <fixed name="flexor"><joint joint="f0" coef="0.9"/><joint joint="f2" coef="0.4"/></fixed>
    <fixed name="four_bar"><joint joint="t0" coef="1"/><joint joint="t2" coef="-2"/></fixed>
    <fixed name="stop" limited="true" range="-3 3">
      <joint joint="f0" coef="1"/><joint joint="f1" coef="1"/>
    </fixed>
  </tendon>
  <equality>
    <joint joint1="t1" joint2="t0" polycoef="0.1 0.7 0 0 0"/>
    <tendon name="four_bar" tendon1="four_bar"/>
  </equality>
  <actuator>
    <position name="finger" tendon="flexor" kp="4" ctrlrange="0 2" forcerange="0 50"/>
    <position name="spread" joint="f1" kp="6" ctrlrange="-0.1 1"/>
    <position name="thumb" joint="t0" gear="2" kp="3" ctrlrange="0 3"/>
  </actuator>
</mujoco>
"""
SPATIAL = """
<mujoco>
  <worldbody>
    <site name="a" pos="0 0 0.01"/>
    <body name="link" pos="0.03 0 0">
      <joint name="q" axis="0 1 0" range="0 {most}" limited="true" stiffness="0.1"/>
      <geom size="0.01"/><site name="b" pos="0.02 0 0.01"/>
    </body>
  </worldbody>
  <tendon><spatial name="wire"><site site="a"/><site site="b"/></spatial></tendon>
  <actuator><position name="pull" tendon="wire" kp="100" ctrlrange="0.03 0.05" forcerange="-9 0"/></actuator>
</mujoco>
"""


def written(folder: Path, text: str, name: str = "hand.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def engine(path: Path) -> tuple[Any, Any]:
    """MuJoCo's own model of the same file, without what is only drawn."""
    text = path.read_text().replace('<geom class="drawn" mesh="shell"/>', "")
    asset = '<asset><mesh name="shell" file="shell.stl"/></asset>'
    model = mujoco.MjModel.from_xml_string(text.replace(asset, ""))
    return model, mujoco.MjData(model)


def postures(hand: HandDescription, count: int = 5) -> np.ndarray:
    return np.random.default_rng(0).uniform(hand.joint_lower, hand.joint_upper, (count, hand.n_q))


def test_every_shape_is_where_mujoco_has_it(tmp_path: Path) -> None:
    path = written(tmp_path, FINGERS)
    hand, (model, data) = load_hand(path), engine(path)
    kinematics = HandKinematics(hand)
    for q in postures(hand):
        for name, angle in zip(hand.joint_names, q, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        poses = kinematics(torch.from_numpy(q))
        for link in hand.urdf.links:
            for shape in link.collisions:
                there = poses.of(link.name).numpy() @ shape.transform
                geom = data.geom(link.name)
                np.testing.assert_allclose(there[:3, 3], geom.xpos, atol=1e-12)
                axes = there[:3, :3].T @ geom.xmat.reshape(3, 3)
                np.testing.assert_allclose(np.abs(axes[2, 2]), 1.0, atol=1e-12)
    assert len(visuals(hand.urdf).of_link["tip"]) == 1  # pictures do with what touches
    masses = {link.name: link.mass for link in hand.urdf.links}
    assert masses["palm"] == 0.5
    assert masses["first"] == pytest.approx(model.body("first").mass[0])


def test_the_transmission_is_mujocos(tmp_path: Path) -> None:
    path = written(tmp_path, FINGERS)
    hand, (model, data) = load_hand(path), engine(path)
    place = [model.joint(name).dofadr[0] for name in hand.joint_names]
    for q in postures(hand):
        for name, angle in zip(hand.joint_names, q, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_forward(model, data)
        moment = np.zeros((model.nu, model.nv))
        sparse = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moment, data.actuator_moment, *sparse)
        np.testing.assert_allclose(hand.actuation_jacobian, moment[:, place], atol=1e-12)
        np.testing.assert_allclose(
            hand.actuator_offset + hand.actuation_jacobian @ q, data.actuator_length, atol=1e-12
        )
    assert [actuator.stiffness for actuator in hand.actuators] == [4, 6, 3]
    assert [actuator.tendon for actuator in hand.actuators] == [True, False, False]
    np.testing.assert_allclose(hand.actuator_upper, [2, 1, 3])
    spring = dict(zip(hand.joint_names, hand.spring_stiffness, strict=True))
    assert spring["f0"] == 0.05
    assert spring["t1"] == 0


def test_couplings_hold_what_mujoco_holds(tmp_path: Path) -> None:
    """The equalities pull the joints to where ``C q = C q0``."""
    path = written(tmp_path, FINGERS)
    hand, (model, data) = load_hand(path), engine(path)
    assert hand.coupling.shape == (2, hand.n_q)
    data.ctrl[:] = [1.0, 0.3, 1.2]
    for _ in range(20_000):
        mujoco.mj_step(model, data)
    q = np.array([data.joint(name).qpos[0] for name in hand.joint_names])
    assert q[hand.joint_names.index("t0")] > 0.4
    np.testing.assert_allclose(hand.coupling @ q, hand.coupling @ hand.spring_rest, atol=2e-3)


def test_a_spatial_tendon_is_measured_by_mujoco(tmp_path: Path) -> None:
    hand = load_hand(written(tmp_path, SPATIAL.format(most=150)))
    # it shortens to pull: `a` is the negative length here
    assert hand.actuators[0].tendon
    assert hand.actuators[0].lower == pytest.approx(-0.05)
    model, data = engine(tmp_path / "hand.xml")
    for angle in (0.1, 1.2):
        data.qpos[:] = angle
        mujoco.mj_forward(model, data)
        q = np.full(hand.n_q, angle)
        J_a = hand.actuation_jacobian
        length, arms = hand.lengths.length(q, J_a), hand.lengths.jacobian(q, J_a)[0]
        np.testing.assert_allclose(length, [-data.ten_length[0]], atol=1e-14)
        np.testing.assert_allclose(arms, -data.ten_J[: hand.n_q], atol=1e-14)


def test_a_template_is_filled_in_and_has_the_last_word(tmp_path: Path) -> None:
    path = written(tmp_path, FINGERS)
    alone = load_hand(path)
    toml = write_template(path)
    with pytest.raises(DescriptionError, match=r"pads\[tip_1\].direction"):
        load_hand(path)
    text = toml.read_text()
    assert "# Assumed: these move and nothing drives them: they are left out: ball" in text
    toml.write_text(
        text.replace('["TODO", "TODO", "TODO"]', "[0.0, 0.0, 1.0]").replace(
            "stiffness = 4.0", "stiffness = 5.0"
        )
    )
    hand = load_hand(path)
    assert [pad.link for pad in hand.pads] == ["tip", "thumb_tip"]
    assert hand.actuators[0].stiffness == 5.0
    np.testing.assert_array_equal(hand.actuation_jacobian, alone.actuation_jacobian)
    np.testing.assert_array_equal(hand.spring_rest, alone.spring_rest)
    with pytest.raises(DescriptionError, match="not overwritten"):
        write_template(path)
    copied = write_transmission(alone, tmp_path / "other.transmission.toml")
    assert copied.is_file()
    assert not (tmp_path / "other.urdf").exists()


def test_check_says_what_is_left_out(tmp_path: Path) -> None:
    rows = check_hand(str(written(tmp_path, FINGERS)), "no object")
    assumed = [row.found for row in rows if row.name == "assumed" and row.state == "warning"]
    said = "left out: stop", "touch nothing: palm", "the joint, which is not where", "left out: ball"
    assert [part in row for part, row in zip(said, sorted(assumed), strict=True)] == [True] * 4
    assert rows[-1].name == "object's files"


def test_files_are_put_together(tmp_path: Path) -> None:
    start, end = FINGERS.index("<tendon>"), FINGERS.index("</mujoco>")
    (tmp_path / "parts").mkdir()
    written(tmp_path / "parts", f"<mujocoinclude>{FINGERS[start:end]}</mujocoinclude>", "drive.xml")
    path = written(tmp_path, FINGERS[:start] + '<include file="parts/drive.xml"/></mujoco>')
    assert load_hand(path).n_a == 3
    digests = file_digests(path, ())
    assert list(digests) == ["hand hand.xml", "hand drive.xml"]
    part = tmp_path / "parts" / "drive.xml"
    part.write_text(part.read_text().replace('coef="0.4"', 'coef="0.5"'))
    assert file_digests(path, ()) != digests  # no old results are taken up


WORLD = '<body name="b"><joint name="j" range="0 1" {more}/><geom size=".01"/></body>'
ACTUATOR = '<actuator><position joint="j" kp="1" ctrlrange="0 1"/></actuator>'


def mjcf(body: str = WORLD.format(more=""), rest: str = ACTUATOR) -> str:
    return f"<mujoco><worldbody>{body}</worldbody>{rest}</mujoco>"


REFUSED = {
    "slides": (mjcf(WORLD.format(more='type="slide"')), "no hinge joint; .* held: j"),
    "no joint": (mjcf("<geom size='.1'/>", ""), "no hinge joint"),
    "no actuator": (mjcf(rest=""), r"\[\[actuators\]\]: at least 1"),
    "loop": (mjcf(rest=ACTUATOR + "<equality><weld body1='b'/></equality>"), "welds bodies"),
    "missing joint": (mjcf(rest=ACTUATOR.replace('"j"', '"k"')), "MuJoCo: .*'k'|unknown"),
    "not XML": ("<mujoco><worldbody>", "not well-formed XML"),
    "another root": ("<robot/>", "must be <mujoco>"),
    "file of an element": (mjcf().replace("<geom", "<geom file='/etc/passwd'"), "only <include> may name"),
    "attached": (
        mjcf().replace("<geom", "<attach model='m' body='b' prefix='p'/><geom"), "<attach> is not supported",
    ),
    "outside": ("<mujoco><include file='../other.xml'/></mujoco>", r"no hinge.*outside .*\.\./other\.xml"),
    "absolute": ("<mujoco><include file='/etc/hostname'/></mujoco>", "no hinge.*outside .*/etc/hostname"),
    "nothing": ("<mujoco><include/></mujoco>", "has no file"),
    "not there": ("<mujoco><include file='gone.xml'/></mujoco>", "no such MJCF file"),
    "huge": ("<mujoco>" + "<!-- x -->" * 500_000 + "</mujoco>", "at most .* bytes"),
    "many": (mjcf("<body/>" * 30_000), "at most 20000 elements"),
    "deep": (mjcf("<body>" * 1200 + "</body>" * 1200), "nested too deep"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_bad_files_are_refused_by_name(name: str, tmp_path: Path) -> None:
    text, said = REFUSED[name]
    folder = tmp_path / "hands"
    folder.mkdir()
    written(tmp_path, mjcf(), "other.xml")
    with pytest.raises(DescriptionError, match=said):
        load_hand(written(folder, text))


def test_a_cycle_of_files_ends(tmp_path: Path) -> None:
    written(tmp_path, "<mujocoinclude><include file='hand.xml'/></mujocoinclude>", "b.xml")
    with pytest.raises(DescriptionError, match="includes this file"):
        load_hand(written(tmp_path, "<mujoco><include file='b.xml'/></mujoco>"))


def test_a_loose_joint_is_named_with_what_to_do(tmp_path: Path) -> None:
    inner = "".join(WORLD.replace('"b"', f'"{k}"').replace('"j"', f'"{k}"').format(more="") for k in "klm")
    body = WORLD.format(more="").replace("</body>", f"{inner}</body>")
    path = written(tmp_path, mjcf(body))
    with pytest.raises(DescriptionError, match=r"holds the joints k, l, m: .*hands --new"):
        load_hand(path)
    assert write_template(path).read_text().count('spring = "TODO"') == 3


def test_what_check_prints_of_a_pad_lies_there_in_the_mjcf(tmp_path: Path) -> None:
    path, link = written(tmp_path, FINGERS), "first"  # which begins at its joints, not where the body does
    pad = ContactPad("pad", link, (0.001, 0.002, 0.01), (0.001, 0.002, 0.02), 0.007)
    pasted = _to_paste(load_hand(path), pad).partition(": ")[2]
    assert pasted.startswith("<geom ")
    path.write_text(path.read_text().replace('<geom name="first"', pasted + '<geom name="first"'))
    shapes = load_hand(path).urdf.link(link).collisions
    found = [shape for shape in shapes if shape.size == (0.007, 0.01)]
    np.testing.assert_allclose(found[0].transform[:3, 3], [0.001, 0.002, 0.015], atol=1e-9)


FINGER = """
<mujoco>
  <worldbody>
    <body name="body_2"><geom size=".01"/><site name="a" pos="0 0 -0.02"/>
      <body pos="0 0 0.02"><joint name="near" axis="0 1 0" range="-60 90" stiffness="0.1"/><geom size=".01"/>
        <site name="b" pos="0 0 0.03"/>
        <body name="far" pos="0 0 0.05">
          <joint name="far" axis="0 1 0" range="0 90" stiffness="0.05"/><geom size=".01"/>
          <site name="c" pos="0.01 0 0.02"/>
        </body>
      </body>{more}
    </body>
  </worldbody>
  <tendon>
    <fixed name="t"{limit}><joint joint="near" coef="1"/><joint joint="far" coef="0.8"/></fixed>{tendons}
  </tendon>
  <actuator>{actuators}</actuator>
</mujoco>
"""
PULL = '<position name="m" tendon="t" kp="4" ctrlrange="0 2"/>'


def finger(folder: Path, actuators: str = PULL, limit: str = "", tendons: str = "", more: str = "") -> Path:
    text = FINGER.format(actuators=actuators, limit=limit, tendons=tendons, more=more)
    return written(folder, text)


@pytest.mark.parametrize(
    ("actuators", "limit", "ends", "note"),
    [
        (PULL, ' range="-1 1.5"', (0.0, 1.5), "ranges of motors end at the limits of their tendons: m"),
        ('<general name="m" tendon="t" gainprm="4" biastype="affine" biasprm="2 -4" ctrlrange="0 2"/>', "",
         (0.5, 2.5), ""),
        ('<general name="m" tendon="t" gainprm="4" biasprm="0 -4" ctrlrange="0 1"/>', ' range="0 2"', (0, 2),
         "actuators without position control are taken as rigid, over their whole stroke: m"),
        ('<intvelocity name="m" tendon="t" kp="4" ctrlrange="-1 1" actrange="0 2"/>', "", (0.0, 2.0), ""),
        (PULL + '<velocity name="d" tendon="t" kv="0.1"/>', "", (0.0, 2.0),
         "actuators that move only what others do are left out: d"),
        (PULL + '<plugin name="p" joint="far" plugin="mujoco.pid"/>', "", (0.0, 2.0),
         "actuators of plugins are left out: p"),
    ],
    ids=["limits of a tendon", "offset", "gain alone", "integrates", "damper", "plugin"],
)  # fmt: skip
def test_actuators_of_other_kinds(actuators, limit, ends, note, tmp_path):
    hand = load_hand(finger(tmp_path, actuators, limit))
    (motor,) = hand.actuators
    assert (motor.lower, motor.upper) == pytest.approx(ends)
    assert motor.stiffness == (np.inf if "gainprm" in actuators and "affine" not in actuators else 4.0)
    assert note in (*hand.notes, "")


def test_a_tendon_without_an_arm_at_rest_is_one(tmp_path: Path) -> None:
    """A band along the finger, which is straight at rest; and one that ties joints, at every posture."""
    sites = '<site site="a"/><site site="b"/>'
    band = f'<spatial name="band" stiffness="200" springlength="0 .04">{sites}</spatial>'
    tie = f'<spatial name="tie" range=".0520 .0521">{sites}<site site="c"/></spatial>'
    hand = load_hand(finger(tmp_path, tendons=band + tie))
    model, data = engine(tmp_path / "hand.xml")
    for q in postures(hand):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        pull = 200 * max(0.0, data.ten_length[1] - 0.04)
        assert hand.tendon_springs.tension(q) == pytest.approx([pull], abs=1e-9)
        assert hand.loops.gap(q) == pytest.approx([data.ten_length[2] - 0.05205], abs=1e-12)


def test_what_is_read_in_part_is_named(tmp_path: Path) -> None:
    spring = '<fixed name="s" stiffness="1 2" frictionloss="0.1"><joint joint="far" coef="1"/></fixed>'
    notes = load_hand(finger(tmp_path, tendons=spring)).notes
    assert "of springs that are not linear the linear part counts: s" in notes
    assert "friction of tendons is left out: s" in notes


def test_replicas_are_made_and_names_are_unique(tmp_path: Path) -> None:
    """A body without a name took another's, which closed a circle of links without end."""
    body = '<body name="z"><joint name="z" axis="0 1 0" stiffness=".1"/><geom size=".01"/></body>'
    more = '<replicate count="{}" offset="0 .02 0">' + body + "</replicate>"
    hand = load_hand(finger(tmp_path, more=more.format(2)))
    assert hand.joint_names == ("near", "far", "z0", "z1")
    assert hand.link_names == ("world", "body_2", "body_2_", "far", "z0", "z1")
    for count in ("1e300", "inf", "9000"):
        with pytest.raises(DescriptionError, match="replicas make more than 20000 elements"):
            load_hand(finger(tmp_path, more=more.format(count)))
