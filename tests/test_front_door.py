"""The front door: light to import, complete, documented; every stage alone on arrays; the files of the commands."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rejoint
from commandline import run_cli
from rejoint.arms import mycobot280, write_arm_toml
from rejoint.control.integrator import IntegratorController
from rejoint.control.shelf import shelf_policy
from rejoint.logs.runlog import write_log
from rejoint.runs.given import is_robot
from rejoint.runs.stages.controllers import make_factories
from rejoint.system.progress import INTERVAL, paced, part

ARM = mycobot280()
TARGETS = [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]]
FUNCTIONS = (
    "compare", "connect", "deploy", "diagnose", "follow", "identify", "load_arm", "read_arm", "repair", "replay",
    "report", "train",
)  # fmt: skip
HEAVY = ("torch", "mujoco", "numba", "matplotlib", "scipy", "pyarrow", "onnxruntime", "numpy", "typer", "rich")


def test_importing_it_loads_nothing_heavy() -> None:
    code = f"import sys, rejoint; print(sorted({set(HEAVY)!r} & set(sys.modules)), dir(rejoint)[:3])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("[] ['AddressError', 'Arm', "), done.stdout + done.stderr


def test_every_name_is_there_for_python_and_for_type_checkers() -> None:
    for name in rejoint.__all__:
        assert getattr(rejoint, name) is not None
    assert set(rejoint.__all__) == set(rejoint._HOME) <= set(dir(rejoint))
    source = Path(rejoint.__file__).read_text(encoding="utf-8")
    block = source[source.index("if TYPE_CHECKING:") : source.index("_HOMES")]
    imported = re.findall(r"from rejoint\.([\w.]+) import (?:\(([^)]+)\)|([^\n]+))", block)
    found = {name.strip(): home for home, many, one in imported for name in (many or one).split(",") if name.strip()}
    assert found == rejoint._HOME
    with pytest.raises(AttributeError, match="no attribute 'repare'"):
        rejoint.repare  # noqa: B018


def test_every_name_stands_in_the_reference_by_itself_or_with_its_module() -> None:
    page = (Path(__file__).parent.parent / "docs" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: rejoint\.([\w.]+)$", page, re.MULTILINE))
    assert {name for name, home in rejoint._HOME.items() if not shown & {name, home}} == {"__version__"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_says_what_it_takes_returns_and_raises(name: str) -> None:
    function = getattr(rejoint, name)
    text = inspect.getdoc(function)
    for section in ("Parameters", "Returns", "Raises", "Examples"):
        assert f"{section}\n{'-' * len(section)}" in text, section
    assert len(re.findall(r"^>>> ", text, re.MULTILINE)) >= 2
    described = text[text.index("Parameters\n") : text.index("Returns\n")]
    named = {word for line in re.findall(r"^(\w[\w, ]*)$", described, re.MULTILINE) for word in line.split(", ")}
    assert set(inspect.signature(function).parameters) <= named


def test_every_type_says_what_it_is() -> None:
    for name in set(rejoint.__all__) - {*FUNCTIONS, "Progress", "__version__"}:
        assert len(inspect.getdoc(getattr(rejoint, name)) or "") > 20, name


@pytest.fixture(scope="module")
def motion() -> rejoint.RunLog:
    """A worn arm that swings all its joints, as arrays from a loop of one's own."""
    robot = rejoint.connect("emulated:worn")
    state, rows = robot.read(), []
    while state.time[0] < 60.0:
        swing = np.sin(2 * np.pi * state.time[0] / np.array([11.0, 13.0, 17.0, 7.0, 9.0, 5.0]))
        rows.append((state.time[0], ARM.rest + 0.25 * swing * min(state.time[0] / 3.0, 1.0), state.position[0]))
        state = robot.step(rows[-1][1][None])
    time, command, position = (np.array(column) for column in zip(*rows, strict=True))
    return rejoint.RunLog.of(time, command, position, arm="mycobot280")


def test_a_log_is_made_of_arrays_and_keeps_copies(motion: rejoint.RunLog, tmp_path: Path) -> None:
    position = np.array(motion.position)
    log = rejoint.RunLog.of(motion.time, motion.command, position, arm=ARM, label="mine")
    position[:] = 0.0
    np.testing.assert_array_equal(log.position, motion.position)
    assert np.isnan(log.target).all()
    log.save(tmp_path / "a.parquet")
    np.testing.assert_array_equal(rejoint.RunLog.load(tmp_path / "a.parquet").command, motion.command)
    with pytest.raises(rejoint.InputError, match="position has shape"):
        rejoint.RunLog.of(motion.time, motion.command, motion.position[:, :5], arm=ARM)


def test_every_stage_works_on_data_in_memory(motion: rejoint.RunLog, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[float] = []
    found = rejoint.diagnose(motion, on_progress=lambda share, _: seen.append(share))
    assert found.diagnosis.condition in ("worn", "bad")
    assert seen == sorted(seen)
    assert seen[0] == 0.0
    twin = rejoint.identify([motion], quick=True)
    assert twin.judgement is not None
    predicted = rejoint.replay(twin, motion).positions[0]
    assert predicted.shape == motion.position.shape
    lag = np.sqrt(np.mean((motion.command - motion.position) ** 2))
    assert np.sqrt(np.mean((predicted - motion.position) ** 2)) < lag

    policy = rejoint.train(twin, quick=True, threads=1)
    action = policy(np.zeros(policy.contract.observation_size))
    assert action.shape == (6,)
    np.testing.assert_array_equal(policy(np.zeros((2, policy.contract.observation_size))), [action, action])
    policy.save("policy.onnx")
    assert rejoint.Policy.load("policy.onnx").content == policy.content
    compared = rejoint.compare("emulated:worn", ["integrator", policy], TARGETS[:1], twin=twin, repetitions=1)
    assert compared.comparison.controllers == ("integrator", "policy")
    assert set(compared.logs) == {
        f"{kind}/{name}/0/0" for kind in ("crossing", "hold") for name in ("integrator", "policy")
    }
    done = rejoint.deploy("emulated:worn", policy, TARGETS, dwell=1.0)
    assert [len(visit.target) for visit in done.visits] == [3, 3]
    assert done.log is not None
    assert done.log.time[-1] - done.log.time[0] == pytest.approx(2.0, abs=0.1)
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"], "nothing else is written"


def test_an_arm_is_driven_before_anything_is_trained(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = rejoint.deploy("emulated:worn", targets=TARGETS, dwell=2.0)
    assert done.controller == "shelf"
    assert all(visit.error < 3e-3 for visit in done.visits)  # open loop leaves 20 mm
    assert not list(tmp_path.iterdir())


def test_an_open_robot_stays_open(monkeypatch) -> None:
    robot = rejoint.connect("emulated:worn")
    monkeypatch.setattr(type(robot), "close", lambda _: pytest.fail("closed"))
    assert rejoint.deploy(robot, "integrator", TARGETS[:1], dwell=1.0).log is not None
    found = rejoint.compare(robot, ["integrator"], TARGETS[:1], repetitions=1)
    assert found.comparison.controllers == ("integrator",)
    assert not found.comparison.batched


def test_controllers_come_in_every_form() -> None:
    own = IntegratorController(ARM)
    found = make_factories(["default", own, lambda arm: IntegratorController(arm)], ARM, None)
    assert list(found) == ["default", "integrator", "controller"]
    assert found["integrator"](ARM) is own
    assert isinstance(found["controller"](ARM), IntegratorController)
    assert list(make_factories([own, IntegratorController], ARM, None)) == ["integrator", "integrator-2"]
    assert list(make_factories({"mine": "integrator"}, ARM, None)) == ["mine"]
    with pytest.raises(rejoint.InputError, match="known controllers"):
        make_factories(["magic"], ARM, None)


def test_an_address_is_told_from_logs(tmp_path: Path) -> None:
    assert is_robot("emulated:worn")
    assert is_robot(rejoint.connect("emulated:worn"))
    assert not is_robot("logs/so101")
    assert not is_robot(tmp_path)
    with pytest.raises(rejoint.FileError, match="no folder with run logs"):
        rejoint.diagnose(tmp_path, arm=ARM)
    with pytest.raises(rejoint.InputError, match="either a run or a twin"):
        rejoint.train("twin.toml", run="runs/mine")
    with pytest.raises(rejoint.InputError, match="neither logs nor a run"):
        rejoint.identify()


def test_what_is_none_of_the_things_taken_is_refused_in_words_before_anything_moves(motion: rejoint.RunLog) -> None:
    robot = rejoint.connect("emulated:worn")
    before = robot.read().time[0]
    wrong = [
        (lambda: rejoint.diagnose(robot.arm), "type Arm was given, expected run logs"),
        (lambda: rejoint.diagnose(motion.position), "expected run logs .rejoint.RunLog.of makes one of arrays"),
        (lambda: rejoint.diagnose("emulated:worn", arm=280), "type int was given, expected an arm, its name"),
        (lambda: rejoint.diagnose("emulated:worn", period=0.02), "shortest and the longest in seconds"),
        (lambda: rejoint.deploy(robot.arm), "type Arm was given, expected a robot"),
        (lambda: rejoint.replay(motion, motion), "type RunLog was given, expected a twin"),
        (lambda: rejoint.report(motion), "type RunLog was given, expected a run or its folder"),
        (lambda: rejoint.diagnose("emulated:worn", run=motion), "expected a run or its folder"),
        (lambda: rejoint.deploy(robot, motion), "type RunLog was given, expected the name of a controller"),
        (lambda: rejoint.deploy(robot, lambda arm: arm), "type Arm was given, expected for controller a controller"),
    ]
    for call, said in wrong:
        with pytest.raises(rejoint.InputError, match=said):
            call()
    assert robot.read().time[0] == before


def test_what_is_returned_is_shown_in_few_words(motion: rejoint.RunLog) -> None:
    assert repr(motion) == f"RunLog({motion.label!r} of {motion.robot}, {motion.arm}: 2395 rows, 60.0 s)"
    assert repr(ARM) == "Arm('mycobot280' with the joints joint1, joint2, joint3, joint4, joint5, joint6)"
    assert len(repr(shelf_policy(ARM))) < 6000, "the network's bytes stay out"


def test_progress_of_a_part_is_progress_of_the_whole() -> None:
    seen = []
    one = part(lambda share, what: seen.append((share, what)), 0.5, 0.75, "arm 1: ")
    one(0.0, "a")
    one(1.0, "b")
    assert seen == [(0.5, "arm 1: a"), (0.75, "arm 1: b")]


def test_a_command_and_its_function_write_the_same_files(motion, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "logs" / "motion.parquet", motion)
    tools = {"capsys": capsys, "monkeypatch": monkeypatch}
    assert run_cli("diagnose", "--logs", "logs", "--run", "command", **tools)[0] == 0
    run = rejoint.Run.plan("function", "logs:logs", ARM)
    assert rejoint.diagnose(Path("logs"), run=run).verdict == run.diagnosis.verdict
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n")
    few = ("--targets", points, "--repetitions", "1", "--controllers", "integrator")
    assert run_cli("compare", "emulated:worn", "command", *few, **tools)[0] == 0
    rejoint.compare("emulated:worn", ["integrator"], points, run="function", repetitions=1)
    names = (
        "diagnosis.json",
        "comparison.json",
        "logs/crossing-integrator-0-0.parquet",
        "logs/hold-integrator-0-0.parquet",
    )
    for name in names:
        assert (tmp_path / "command" / name).read_bytes() == (tmp_path / "function" / name).read_bytes(), name
    with pytest.raises(rejoint.InputError, match="is a run of logs:logs"):
        rejoint.diagnose("emulated:worn", run="function")


def test_a_notebook_s_own_interruption_stays_as_it_is() -> None:
    """Whoever has not installed our signal handlers gets KeyboardInterrupt, from us as from Python."""
    assert issubclass(rejoint.Interrupted, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        rejoint.deploy("emulated:worn", "integrator", TARGETS, dwell=1.0, on_progress=_interrupt)


def _interrupt(share: float, what: str) -> None:
    raise KeyboardInterrupt


def test_progress_is_told_at_the_start_ten_times_a_second_and_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, told = iter(np.arange(0.0, 10.0, 0.01)), []
    monkeypatch.setattr("rejoint.system.progress.time.monotonic", lambda: next(clock))

    @paced
    def work(steps: int, *, on_progress: rejoint.Progress) -> int:
        for k in range(steps):
            on_progress(k / steps, "working")
        return steps

    assert work(500, on_progress=lambda share, what: told.append((share, what))) == 500
    assert (told[0], told[-1]) == ((0.0, "working"), (1.0, "done"))
    assert len(told) == pytest.approx(5.0 / INTERVAL, abs=2)
    assert [share for share, _ in told] == sorted({share for share, _ in told})
    assert list(inspect.signature(work).parameters) == ["steps", "on_progress"]


def test_what_an_arm_file_leaves_out_is_told(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    write_arm_toml(file, ARM)
    assert rejoint.read_arm(file).notes == ()
    text = re.sub(r"(?m)^encoder_counts_per_turn.*\n", "", file.read_text(encoding="utf-8"))
    file.write_text(text, encoding="utf-8")
    loaded = rejoint.read_arm(file)
    assert loaded.arm.encoder_step == rejoint.load_arm(file).encoder_step
    assert loaded.notes == ("encoders: no resolution given; 4096 steps a turn assumed",)
