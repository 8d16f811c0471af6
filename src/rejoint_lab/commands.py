"""Commands of the lab: `rejoint emulate`, and the group `rejoint research` about controllers on many arms."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.arms import CATALOGUE, Arm, load_arm, mycobot280
from rejoint.cli import CommandGroup, command_group, texts
from rejoint.cli.options import Call, controller_names, takes
from rejoint.robots.wireserver import TerminalServer
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import part
from rejoint_lab.family import SIMULATOR
from rejoint_lab.research import look_up

if TYPE_CHECKING:
    from rejoint_lab.research.evaluation.evaluate import Contestant, Evaluation

DIED = 1
"""Exit code after the fault ``die``"""


@takes
def emulate(
    call: Call,
    arm: str = "mycobot280",
    wear: str | None = None,
    host: str = "127.0.0.1",
    port: int = 9000,
    pty: bool = False,
    log: Path | None = None,
    fault: str = "",
    seed: int = 0,
) -> object:
    """Serve a worn arm in real time on its own wire protocol, until Ctrl-C."""
    require("rejoint emulate", SIMULATOR)
    from rejoint_lab.emulator import dynamixel, feetech, firmware, servers
    from rejoint_lab.emulator.faults import SERVO_BUS, parse_faults
    from rejoint_lab.emulator.servobus import BusSession

    chosen = load_arm(arm)
    if chosen.name not in CATALOGUE:
        raise InputError(f"no wire protocol is known for {chosen.name}; expected --arm {' or '.join(CATALOGUE)}")
    wear = wear or ("so101" if chosen.name == "so101" else "worn")
    faults = parse_faults(fault, chosen.joints)
    for one in () if chosen.servos else SERVO_BUS:
        if one in faults:
            raise InputError(f"the fault {one} is one of an arm on its servos' own bus, as --arm so101 is")
    with suppress(KeyboardInterrupt), ExitStack() as stack:
        truth = None if log is None else stack.enter_context(closing(servers.TruthLog(log, chosen.joints)))
        kind: Any = firmware.Firmware
        if chosen.servos:
            kind = dynamixel.XArm if chosen.name in dynamixel.FITTINGS else feetech.StsArm
        conversation: Any = BusSession if chosen.servos else servers.WireSession
        session = conversation(kind.build(chosen, wear, seed=seed), seed=seed, faults=faults, log=truth)
        server = TerminalServer(session) if pty else servers.on_port(session, host, port)
        stack.callback(server.stop)
        call.message(f"{chosen.name} with the wear profile '{wear}' answers at {server.address}  (Ctrl-C ends it)")
        if not pty:
            call.say_open(host)
        if fault:
            call.message(f"Faults: {fault}")
        server.run()
        if server.died:
            os._exit(DIED)
    call.message("Emulator ended.")
    return {"wear": wear, "address": server.address, "faults": fault}


class ResearchGroup(CommandGroup):
    """The commands of `rejoint research`."""

    table = texts(__package__)["commands"]


research = command_group(ResearchGroup, "research", texts("rejoint.cli")["commands"]["research"]["help"])

OUT = Path("runs") / "family"
CLASSICAL = "integrator,feedforward,tuned-feedforward"
"""Controllers that take part by default"""


@takes
def evaluate(
    call: Call,
    policy: list[Path] | None = None,
    controllers: str = CLASSICAL,
    variants: str = "all",
    arms: int = 100,
    targets: int = 5,
    crossings: int = 10,
    gains: Path | None = None,
    out: Path = OUT,
    seed: int = 0,
) -> object:
    """Try controllers on a hundred arms on which nothing was chosen, and on the same under harder conditions."""
    arm = _arm(call)
    from rejoint_lab.research.evaluation.evaluate import KNOWN
    from rejoint_lab.research.evaluation.evaluate import evaluate as run
    from rejoint_lab.research.evaluation.family import VARIANTS, ArmFamily

    names = {"all": KNOWN, "none": ()}.get(controllers, controller_names(controllers))
    chosen = look_up(VARIANTS, controller_names(variants))
    family = ArmFamily(arms=arms, targets=targets, crossings=crossings, seed=seed)
    contestants, file = _contestants(arm, [*names, *map(str, policy or ())], gains), out.resolve() / "evaluation.json"
    with call.bar("evaluate") as update:
        return _show(call, run(arm, contestants, chosen.values(), family, file, update), file)


@takes
def calibrate(
    call: Call,
    controller: str = "shelf",
    variants: str = "all",
    arms: int = 100,
    targets: int = 5,
    out: Path = OUT,
    seed: int = 0,
) -> object:
    """Find what outside measurements bring: true errors of many arms before and after their calibration."""
    arm = _arm(call)
    from rejoint_lab.research.evaluation.evaluate import evaluate_calibrations
    from rejoint_lab.research.evaluation.family import CALIBRATED, ArmFamily

    (one,) = _contestants(arm, [controller])
    conditions = look_up(CALIBRATED, controller_names(variants)).values()
    family = ArmFamily(arms=arms, targets=targets, crossings=0, seed=seed)
    file = out.resolve() / "calibration.json"
    with call.bar("calibrate") as update:
        return _show(call, evaluate_calibrations(arm, conditions, one, family, file, update), file)


@takes
def follow(call: Call, arms: int = 100, out: Path = OUT, seed: int = 0) -> object:
    """Let many arms follow standard paths, each with a twin of its own."""
    arm = _arm(call)
    from rejoint_lab.research.evaluation.evaluate import evaluate_moving, moving_table
    from rejoint_lab.research.evaluation.family import ArmFamily

    with call.bar("follow") as update:
        found = evaluate_moving(arm, ArmFamily(arms=arms, seed=seed), out, update)
    write_json(out / "moving.json", found)
    call.table(*moving_table(found))
    call.result(f"All of it: {(out / 'moving.json').resolve()}")
    return found


@takes
def tune(
    call: Call,
    rivals: list[str],
    generations: int = 40,
    out: Path = Path("gains.json"),
    seed: int = 0,
) -> object:
    """Tune classical rivals by CMA-ES on the randomised twins that policies are trained on."""
    require("rejoint research tune", "train")
    from rejoint.training.ranges import BroadRanges
    from rejoint_lab.research.rivals import RIVALS
    from rejoint_lab.research.rivals import tune as search

    arm = call.arm()
    ranges, chosen = BroadRanges(arm=arm), look_up(RIVALS, rivals)
    known = read_json(out, dict[str, dict[str, float]]) if out.exists() else {}
    tuned = {}
    with call.bar("tune") as update:
        for k, (name, rival) in enumerate(chosen.items()):
            ahead = part(update, k / len(chosen), (k + 1) / len(chosen), f"{name}: ")
            tuned[name] = search(arm, ranges, rival, ahead, generations=generations, seed=seed)
            write_json(out, known | tuned)
    for name, gains in tuned.items():
        call.table(f"Gains of {name}", ["gain", "value"], [(gain, str(value)) for gain, value in gains.items()])
    call.result(f"Next: rejoint research evaluate --controllers {','.join(chosen)} --gains {out}")
    return {"out": out, "gains": tuned}


@takes
def reproduce(
    call: Call,
    experiments: list[str] | None = None,
    run: Path | None = None,
    quick: bool = False,
    seed: int = 0,
) -> object:
    """Run the experiments of Park et al. 2024 and write a page with their numbers beside ours."""
    require("rejoint research reproduce", "train", "report")
    from rejoint_lab.research.reproduction.campaign import EXPERIMENTS, Bench, run_experiments, write_page

    chosen = look_up(EXPERIMENTS, experiments or ())
    folder = run or Path("runs") / f"reproduction{'-quick' * quick}-seed{seed}"
    with call.bar("reproduce") as update:
        bench = Bench(folder=folder.resolve(), arm=mycobot280(), seed=seed, on_progress=update)
        bench = bench.quickly() if quick else bench
        found = run_experiments(bench, chosen, lambda one: call.message(one.title))
    for name, finished in found.items():
        call.table(chosen[name].title, ["", "ours", "paper"], finished.numbers)
    page = write_page(bench)
    call.result(str(page))
    return {"page": page, "run": folder, "found": found}


def _arm(call: Call) -> Arm:
    require("rejoint research", "train", "report")
    return call.arm()


def _contestants(arm: Arm, words: list[str], gains: Path | None = None) -> list[Contestant]:
    from rejoint_lab.research.evaluation.evaluate import classical, learned

    tuned = None if gains is None else read_json(gains, dict[str, dict[str, float]])
    if not words:
        raise InputError("no controller takes part; name --controllers or give a --policy")
    return [learned(Path(word), arm) if word.endswith(".onnx") else classical(word, tuned) for word in words]


def _show(call: Call, found: Evaluation, file: Path) -> dict[str, object]:
    from rejoint_lab.research.evaluation.evaluate import terminal_tables

    for table in terminal_tables(found):
        call.table(*table)
    call.result(f"All of it: {file}")
    rows = [{"variant": variant} | vars(row) for variant, one in found.comparisons.items() for row in one.rows]
    return {"out": file.parent, "best": found.best, "rows": rows, "pairs": found.pairs}
