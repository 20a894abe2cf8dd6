"""A wrong option of any command is told in one line, and ends with 1 or 2; nothing is written."""

import shlex
from pathlib import Path

import pytest

from torch_ekm.cli import main
from torch_ekm.exceptions import ParameterError

MESH_ONLY = """<robot name="finger"><link name="base"/><link name="tip"><collision><geometry>
<mesh filename="a.stl"/></geometry></collision></link><joint name="knuckle" type="revolute">
<parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
TRANSMISSION = """[hand]
name = "finger"
[joints]
knuckle = { spring = 0.1 }
[[actuators]]
name = "motor"
range_deg = [0, 50]
moment_arms = { knuckle = 1.0 }
"""
THING = """<robot name="thing"><link name="thing"><inertial><mass value="0.1"/><inertia ixx="1e-5"
ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/></inertial>
<collision><geometry><mesh filename="a.stl"/></geometry></collision></link></robot>"""
WRONG = """
nonsense | No such command
--nonsense | No such option
hands --new file.txt | a path to a .urdf, .xml or .mjcf file
hands --new none.urdf | no such URDF file
hands --new broken.urdf | not well-formed XML
hands --new finger.urdf | not overwritten
hands --new thing.urdf | no revolute or continuous joint
objects extra | unexpected extra argument
check icub_right box --picture folder | cannot be written
check icub_right box --picture none/a.png | cannot be written
check icub_right box --picture a.xyz | ends in .png
demo nothing | unknown object
demo thing.urdf | found a mesh
demo box --hand nothing | unknown hand
demo box --hand folder | unknown hand
demo box --hand '' | unknown hand
show finger.urdf --object box | two [[pads]]
demo box --seeds -1 | 0 <= FIRST < END
demo box --seeds 5:3 | 0 <= FIRST < END
demo box --seeds a | 0 <= FIRST < END
demo box --seeds 0:99999999 | at most 10000 seeds
demo box --jobs 0 | --jobs
demo box --out file.txt | cannot be written
reproduce nothing | unknown experiment
reproduce online --objects box | 'online' does not take it
reproduce generalize --objects nothing | unknown object
reproduce generalize --objects , | at least one object
reproduce generalize --preset bad | unknown preset
reproduce generalize --learner bad | unknown learner
compare | Missing option '--data'
compare --data none.csv | no such file
compare --data folder | (--clock)
compare --data folder.csv | no such file
compare --data broken.urdf | are not read
compare --data t42 | TORCH_EKM_DATA
compare --data s.csv --learners bad | unknown learner
compare --data s.csv --learners , | names of learners
compare --data s.csv --data s.csv | different names
compare --data s.csv --targets bad | unknown column
compare --data s.csv --targets a,y | at least one must be an input
compare --data s.csv --limit -1 | --limit
compare --data s.csv --limit 3 | too short
compare --data s.csv --learners SOGP --out file.txt | cannot be written
show nothing | unknown hand
show finger.urdf | no link has a <visual> or <collision>
show icub_right --seed -1 | --seed
show icub_right --reach | without an object
show icub_right --html folder | cannot be written
show icub_right --html none/a.html | cannot be written
replay none | no such log
replay file.txt | damaged, or not a recording
replay folder --trial -1 | --trial
notebooks --copy file.txt | this is a file
notebooks --copy file.txt/x | cannot be written
""".strip().splitlines()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    for name in ("folder", "folder.csv"):
        (folder / name).mkdir()
    (folder / "file.txt").touch()
    (folder / "broken.urdf").write_text("no XML")
    (folder / "finger.urdf").write_text(MESH_ONLY)
    (folder / "finger.transmission.toml").write_text(TRANSMISSION)
    (folder / "thing.urdf").write_text(THING)
    (folder / "thing.object.toml").write_text(
        "[object]\nname = 'thing'\nfriction = 0.8\ngrasp_width = 0.03\n"
    )
    (folder / "s.csv").write_text("\n".join(["a,y", *["1,2"] * 50]))
    return folder


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_option_is_told_in_one_line(case, place, monkeypatch, capsys):
    command, _, told = case.partition(" | ")
    monkeypatch.chdir(place)
    monkeypatch.delenv("TORCH_EKM_DATA", raising=False)
    monkeypatch.setattr("sys.argv", ["torch-ekm", *shlex.split(command)])
    before = sorted(place.iterdir())
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code in (1, 2), said
    assert told in said
    assert said.startswith("torch-ekm: ")
    assert said.count("\n") == 1
    assert sorted(place.iterdir()) == before


def test_the_job_in_which_it_went_wrong_is_told(monkeypatch, capsys):
    def fails(**options: object) -> None:
        error = ParameterError("dead_zone", -1.0, "positive")
        error.add_note("in the job 'box_1000'")
        raise error

    monkeypatch.setattr("torch_ekm.cli.app", fails)
    with pytest.raises(SystemExit):
        main()
    assert capsys.readouterr().err.endswith("; in the job 'box_1000'\n")
