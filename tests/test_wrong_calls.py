"""Calls as somebody writes them who did not write the program: each ends in one clear line and harms nothing."""

import shlex
import zipfile

import pytest

import rejoint
from rejoint.arms import mycobot280, write_arm_toml
from rejoint.runs.run import Run

FILES = {
    "metres.csv": "x,y,z\n0.2,0,0.15\n",
    "far.csv": "x,y,z\n900,0,180\n",
    "short.csv": "x,y\n200,0\n",
    "hole.csv": "x,y,z\n200,,180\n",
    "ragged.csv": "x,y,z\n1,2\n",
    "words.csv": "x,y,z\n200,0,180\none,0,180\n200,0,180\ntwo,0,180\n",
    "titles.csv": "x,y,z\n",
    "empty.csv": "",
    "letter.csv": "hello\nworld\n",
    "twice.csv": "time,x,y,z\n0,200,0,180\n0,200,10,180\n",
    "one-joint.csv": "time_s,position.joint1_deg\n0,1\n0.1,2\n",
    "abc.csv": "a,b,c\n1,2,3\n",
    "space.toml": '[[arm]]\nname = "a b"\naddress = "emulated:worn"\n',
    "typo.toml": '[[arm]]\nname = "a"\naddres = "emulated:worn"\n',
    "wear.toml": "x = 1\n",
    "broken.urdf": "<robot>",
    "bad/run.json": "{",
}
CALLS = """
deploy emulated:worn --targets metres.csv | metres
diagnose emulated:worn?speed=3 | unknown field `speed`
deploy emulated:worn --targets far.csv | out of reach
deploy emulated:worn --targets short.csv | missing: z
deploy emulated:worn --targets hole.csv | line 2
deploy emulated:worn --targets ragged.csv | line 2
deploy emulated:worn --targets words.csv | line 3, column x: 'one' is no number (also wrong: line 5
deploy emulated:worn --targets titles.csv | no targets
deploy emulated:worn --targets empty.csv | empty
deploy emulated:worn --targets letter.csv | hello
deploy emulated:worn --targets book.xlsx | save it as CSV
deploy emulated:worn --targets picture.png | no text
deploy emulated:worn --targets folder | a folder
deploy emulated:worn --targets nothing.csv | no such file
deploy emulated:worn nothing | no run folder
deploy emulated:worn bad | run.json
deploy emulated:worn folder | no run folder
deploy emulated:worn --controller policy | policy file
deploy emulated:worn run --controller policy | truncated or damaged
deploy emulated:worn --tool 0,0,0.06 | 0,0,0.06 are no millimetres (metres?); give such as 0,0,50
deploy emulated:worn --controller feedforwad | feedforward
deploy emulated:worn --controller file.onnx | no such file
deploy emulated:worn --dwell -1 | found '-1'
deploy emulated:worn --within=0 | found '0'
deploy emulated:worn --payload 100g | kg
deploy emulated:worn --payload 250 | kg
deploy emulated:worn --payload -1 | kg
deploy emulated:worn --period 0.05 | milliseconds
deploy emulated:worn --tool 0,0 | x,y,z
deploy emulated:warn | worn
deploy worn | emulated:worn
deploy so101 | emulated:so101
deploy 192.168.1.20 | tcp://192.168.1.20:9000
deploy 192.168.1.20:9000 | tcp://192.168.1.20:9000
deploy bench-3:6000 | dynamixel://bench-3:6000
deploy /dev/ttyACM0 | feetech:///dev/ttyACM0
deploy /dev/ttyUSB0 | dynamixel:///dev/ttyUSB0
deploy http://192.168.1.20:9000 | tcp://192.168.1.20:9000
deploy tcp:/192.168.1.20:9000 | tcp://HOST:PORT
deploy tcp://127.0.0.1:1 | nothing answers
deploy tcp://127.0.0.1:99999 | 65535
deploy feetech:///dev/ttyACM99 | no port /dev/ttyACM99
deploy feetech://127.0.0.1:1?q=4 | 'q=4'
deploy feetech:///dev/ttyACM99?calibration=none.json | none.json
deploy COM3 | Windows
diagnose 'C:\\logs' | --logs FOLDER
deploy bench-9 | rejoint arms
goto emulated:worn 0.2 0 0.15 | metres
goto emulated:worn 200 0 | 'Z'
goto emulated:worn 200 zero 150 | 'Y'
goto emulated:worn 900 0 150 | nearest place
goto emulated:worn 200 0 -50 | floor
follow emulated:worn run circle-8 | no standard path; standard are circle-8s
follow emulated:worn run circle-0.5s | give the path more time there
follow emulated:worn run circle-8s --payload 150 | 150 kg, expected 0 to the 0.71 kg
follow emulated:worn run twice.csv | point 2
follow emulated:worn run | 'PATH'
identify | --logs FOLDER
identify run | rejoint diagnose
identify folder | no run folder
identify --logs folder --arm so101 --gain a=half | MOTION=NUMBER
train run | rejoint identify run
train run --learner td3 | ppo
compare emulated:worn run --controllers integrator,shelff | 'shelff'
compare emulated:worn run --controllers magic | known controllers
compare emulated:worn run --sets 0 | --sets
report nothing | no run folder
open nothing | no run folder
open run | rejoint report run
runs nothing | no such folder
export run --format ufdr | urdf
export nothing.parquet out.csv | no such file
export abc.csv out.mcap | rejoint import
import one-joint.csv logs | --arm
import abc.csv logs | --arm
import abc.csv logs --arm koch | position.JOINT
import book.xlsx logs --arm koch | CSV
import nothing logs --arm koch | no such file
import folder logs --arm koch | a folder with none
replay run/twin.toml --logs folder | twin.toml
history nothing | no such folder
check emulated:worn --tolerance three | 'three'
fleet check space.toml | 'a b'
fleet check typo.toml | addres
fleet chek typo.toml | 'chek'
fleet check nothing.toml | no such file
emulate --wear warn --port 0 | worn
emulate --port 70000 | 65535
emulate --arm ur5 | known arms
emulate --fault drop=5 --port 0 | drop=P
repair emulated:worn --arm broken.urdf | broken.urdf
repair emulated:worn --arm robot.urdf | robot.urdf
repair emulated:worn --arm ur5e | known arms
repair emulated:healthy --run run | is a run of emulated:worn
repair emulated:worn --measure ruler | touch
repair emulated:worn --measure camera=front | camera=NUMBER
repair emulated:wear.toml | wear.toml
calibrate emulated:worn run --measure none | repair
calibrate emulated:worn run --frame table | touch
calibrate emulated:worn new --measure points=book.xlsx | CSV
calibrate emulated:worn new --measure points=nothing.csv | no such file
board x.png | ends in .pdf
board x.pdf --on wall | --on
board x.pdf --squares 7 | such as 7x5
research reproduce table-9 | table-4
serve emulated:worn nothing | no run folder
gains emulated:worn run | no servo gains that could be set; an SO-101
arms add | NAME ADDRESS
arms add bench emulated:wron | wron
arms add 'bench 3' emulated:worn | bench-3
arms add bench tcp://10.0.0.1:9000 --calibration a.json | leave it out
arms remove bench | there is no arm 'bench'
diagnose tcp://nowhere | tcp://nowhere
diagnose carrier-pigeon:1 | emulated:PROFILE
diagnose emulated:worn --logs folder | either
diagnose --logs nothing | rejoint import
diagnose emulated:worn --quik | --quick
rapair | 'repair'
repiar | 'repair', 'report', 'replay'? See
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    (folder / "bad").mkdir()
    (folder / "folder").mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    (folder / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(200))
    with zipfile.ZipFile(folder / "book.xlsx", "w") as book:
        book.writestr("xl/workbook.xml", "<workbook/>")
    Run.create(folder / "run", "emulated:worn", mycobot280()).folder.policy.write_bytes(b"half a policy")
    return folder


def there(place):
    return sorted(path for path in place.rglob("*") if path.is_file() and path.name != ".lock")


@pytest.mark.parametrize("line", CALLS.strip().splitlines())
def test_a_wrong_call_ends_in_one_line_that_says_what_to_do(line, place, cli, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(place / "config"))
    words, _, named = line.rpartition(" | ")
    before = there(place)
    error = cli(*shlex.split(words), code=2).error
    assert named in error
    assert len(error) < 420
    assert there(place) == before


def test_an_arm_has_a_name_that_every_command_takes(tmp_path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "zeros.json").write_text("{}")
    wired = cli("arms", "add", "left", "feetech:///dev/ttyACM99", "--calibration", "zeros.json", "--json").last
    assert wired["address"] == f"feetech:///dev/ttyACM99?calibration={tmp_path / 'zeros.json'}"
    cli("arms", "add", "bench-3", "emulated:worn?seed=3", "--tolerance", "5")
    assert "already" not in cli("arms", "add", "bench-3", "emulated:healthy", code=2).error
    assert set(cli("arms", "--json").last["arms"]) == {"left", "bench-3"}
    assert cli("goto", "bench-3", "180", "0", "200", "--json").last["reached"]
    checked = cli("check", "bench-3", "--history", "seen", "--json", code=None).last
    assert (checked["arm"], checked["robot"]) == ("bench-3", "emulated:worn?seed=3")
    assert "rejoint repair bench-3" in checked["line"]
    assert "runs/bench-3-emulated" in cli("repair", "bench-3", "--preset", "none", code=2).err
    cli("arms", "remove", "left")
    (tmp_path / "config" / "rejoint" / "FLEET.toml").rename(tmp_path / "FLEET.toml")  # that of a fleet, here
    assert cli("arms", "--json").last["arms"] == {"bench-3": "emulated:worn?seed=3"}
    cli("arms", "remove", "bench-3")
    assert "NAME ADDRESS" in cli("arms").out


def test_a_named_arm_with_a_description_is_deployed_with_its_run(tmp_path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    Run.create("run", "emulated:worn", mycobot280())
    write_arm_toml(tmp_path / "mine.toml", mycobot280())
    cli("arms", "add", "bench-3", "emulated:worn", "--arm", "mine.toml")
    cli("deploy", "bench-3", "run", "--controller", "default", "--dry-run", code=5)
    for robot in ("emulated:worn", "bench-3"):
        assert "give another --run" in cli("deploy", robot, "run", "--arm", "so101", code=2).error


def test_runs_are_listed_the_newest_first_and_their_reports_opened(tmp_path, cli, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    for name in ("one", "lab/repairs/a1/002"):
        Run.create(f"runs/{name}", "emulated:worn", mycobot280())
    (tmp_path / "runs" / "three").mkdir()
    (tmp_path / "runs" / "three" / "run.json").write_text("{")
    told = cli("runs", "--json")
    assert [one["run"] for one in told.last["runs"]] == ["runs/lab/repairs/a1/002", "runs/one"]
    assert "left out: runs/three" in caplog.text
    page = rejoint.report("runs/one")
    cli("open")
    cli("open", "runs/one")
    assert opened == [page.resolve().as_uri()] * 2


def test_more_is_said_on_request(cli):
    assert "Traceback" in cli("deploy", "emulated:warn", "-v", code=2).err
    assert cli("-V").out == cli("--version").out
