"""Files of strangers: whatever their size, depth and figures, an answer within seconds, and a typed one."""

import re
import time
from pathlib import Path

import pytest
from own_files import copied

from torch_ekm.description import load_hand, load_object
from torch_ekm.exceptions import DescriptionError

_PATIENCE = 20.0  # [s] of CPU, of which a busy machine takes more

TOML = {
    "nested arrays": "x = " + "[" * 100_000,
    "nested arrays on many lines": "x = " + "[\n" * 100_000,
    "closed nested arrays": "x = " + "[\n" * 300 + "]\n" * 300,
    "nested tables": "x = " + "{a=" * 1000 + "1" + "}" * 1000,
    "dotted key": ".".join("a" * 100_000) + " = 1",
    "dotted keys": "\n".join(f"b{k}." + ".".join("a" * 2000) + " = 1" for k in range(4)),
    "dotted tables": "\n".join(f"[b{k}." + ".".join("a" * 2000) + "]" for k in range(4)),
    "long integer": "x = " + "9" * 1_000_000,
    "integer": "x = " + "9" * 4000,
    "hexadecimal": "x = 0x" + "f" * 4000,
    "float": "x = 1" + "0" * 4000 + ".0",
    "many keys": "\n".join(f"k{i} = 1" for i in range(4000)),
    "large": "# " + "x\n# " * 1_000_000,
    "bytes": "\x00",
    "not UTF-8": "\udcff",
}


@pytest.mark.parametrize("name", TOML)
def test_toml(name: str, tmp_path: Path) -> None:
    (urdf, about), (hand, transmission) = copied(tmp_path, "box"), copied(tmp_path, stem="hand")
    hostile, whole = TOML[name].encode(errors="surrogateescape"), about.read_bytes()
    for content in (hostile, hostile + b"\n" + whole, whole + b"\n[notes]\n" + hostile):
        about.write_bytes(content)
        start, told = time.process_time(), "in notes"
        try:
            load_object(urdf)
        except DescriptionError as error:
            told = str(error)
        assert time.process_time() - start < _PATIENCE
        assert len(told) < 3000
        assert told != "in notes" or name in ("float", "many keys")  # which may be any text
    transmission.write_bytes(hostile)
    with pytest.raises(DescriptionError):
        load_hand(hand)


def chain(n: int) -> str:
    links = "".join(f'<link name="l{k}"/>' for k in range(n))
    joint = (
        '<joint name="j{0}" type="revolute"><parent link="l{0}"/><child link="l{1}"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    )
    joints = "".join(joint.format(k, k + 1) for k in range(n - 1))
    return f'<robot name="r">{links}{joints}</robot>'


def shaped(shape: str, n: int = 1) -> str:
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    collision = f"<collision><geometry>{shape}</geometry></collision>"
    return f'<robot name="r"><link name="l">{mass}{collision * n}</link></robot>'


URDF = {
    "10000 links": chain(10_000),
    "400 links": chain(400),
    "nested": "<robot>" + "<link>" * 200_000 + "</link>" * 200_000 + "</robot>",
    "nested in a link": '<robot><link name="l">' + "<a>" * 100_000 + "</a>" * 100_000 + "</link></robot>",
    "long number": shaped(f'<sphere radius="{"9" * 1_000_000}"/>'),
    "number": shaped('<sphere radius="1e300"/>'),
    "long name": shaped("<a/>").replace('name="l"', f'name="{"l" * 1_000_000}"'),
    "many shapes": shaped('<sphere radius="0.1"/>', 5000),
    "2000 capsules": shaped('<capsule radius="0.1" length="0.2"/>', 2000),
    "many attributes": "<robot " + " ".join(f'a{k}="1"' for k in range(100_000)) + "/>",
    "large": "<robot>" + " " * 5_000_000 + "</robot>",
    "encoding": '<?xml version="1.0" encoding="nonsense"?><robot/>',
}


@pytest.mark.parametrize("name", URDF)
def test_urdf(name: str, tmp_path: Path) -> None:
    for thing in ("box", "planar_two_finger"):
        urdf, _ = copied(tmp_path, thing)
    urdf.write_text(URDF[name])
    start = time.process_time()
    with pytest.raises(DescriptionError) as told:
        load_hand(urdf)
    assert len(str(told.value)) < 3000
    if name != "2000 capsules":  # one body of that many shapes is an object
        with pytest.raises(DescriptionError):
            load_object(urdf)
    assert time.process_time() - start < _PATIENCE


def test_the_longest_hand_that_is_read(tmp_path: Path) -> None:
    """As deep as a file may be: planes are checked link by link."""
    n = 400
    (tmp_path / "my.urdf").write_text(chain(n))
    names = [f"j{k}" for k in range(n - 1)]
    joints = "\n".join(f"{name} = {{ spring = 1.0 }}" for name in names)
    text = (
        f'[hand]\nname = "long"\nbase_link = "l0"\nplanar_normal = [0, 0, 1]\n[joints]\n{joints}\n'
        "[[actuators]]\n"
        'name = "a"\nrange = [0, 1]\nmoment_arms = { j0 = 1.0 }\n[[pads]]\nname = "p"\nlink = "l9"\n'
        "start = [0, 0, 0]\nradius = 0.01\n"
    )
    (tmp_path / "my.transmission.toml").write_text(text)
    start = time.process_time()
    hand = load_hand(tmp_path / "my.urdf")
    assert hand.n_q == n - 1
    assert time.process_time() - start < _PATIENCE


FILES = {  # of a hand and of an object, and what reads them
    "hand.urdf": load_hand,
    "hand.transmission.toml": load_hand,
    "thing.urdf": load_object,
    "thing.object.toml": load_object,
}


@pytest.mark.parametrize("name", FILES)
def test_text_is_utf_8_whoever_wrote_it(name: str, tmp_path: Path) -> None:
    copied(tmp_path, stem="hand")
    copied(tmp_path, "box", "thing")
    path, read = tmp_path / name, FILES[name]
    text, first = path.read_text(encoding="utf-8"), tmp_path / f"{name.partition('.')[0]}.urdf"
    plain = read(first)
    comment = "<!-- Größe -->" if name.endswith("urdf") else "# Größe\n"
    written = text.replace("?>", f"?>{comment}", 1) if name.endswith("urdf") else comment + text
    for change in ("\n", "\r\n"):
        path.write_bytes(written.replace("\n", change).encode("utf-8-sig"))
        assert repr(read(first)) == repr(plain)
    for encoding in ("latin-1", "utf-16", "utf-32", "utf-16-le"):
        path.write_bytes(written.encode(encoding))
        with pytest.raises(DescriptionError, match=rf"{name}: line \d+: byte \d+.*is not UTF-8.*iconv"):
            read(first)


@pytest.mark.parametrize(
    "figure", ["0_1", "1_000.0", "０.１", "0x1p3", "1,5", "1e", "infinity", "nan", "1 2"]
)
def test_figures_of_a_urdf_are_those_of_the_standard(figure: str, tmp_path: Path) -> None:
    path, _ = copied(tmp_path, "box")
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r'<mass value="[^"]*"', f'<mass value="{figure}"', text), encoding="utf-8")
    with pytest.raises(DescriptionError, match="'value' must be a finite number"):
        load_object(path)
    path.write_text(re.sub(r'<mass value="[^"]*"', '<mass value=" +.25E0 "', text), encoding="utf-8")
    assert load_object(path).mass == 0.25
