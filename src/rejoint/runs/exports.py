"""Results about an arm for other programs: models, joint zeros, servo gains, data sheet, controller."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Displacement, gravity_torque
from rejoint.arms.loading import unit_arm, write_urdf
from rejoint.arms.workspace import posture_grid
from rejoint.control.comparison.recommend import achieves
from rejoint.control.controllers.catalogue import POLICY, SHELF, shelf_policy
from rejoint.control.controllers.feedforward import CommandLaw, FeedforwardController
from rejoint.control.controllers.policy import check_contract
from rejoint.control.servogains import in_words, inner_name
from rejoint.diagnosis.calibration.calibration import OFFSET, Calibration
from rejoint.logs.joints import corrected_homing, write_homing
from rejoint.pages.html import render
from rejoint.runs.run import Run
from rejoint.runs.stages.fitting import gains_to_keep
from rejoint.session.context import ControllerMaker, quick_note
from rejoint.session.inputs import RunLike, as_calibration, laden
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import write_bytes, write_text
from rejoint.system.shell import __version__
from rejoint.twin.parameters import STRIBECK_SPEED, back_emf
from rejoint.twin.twin import Twin

KINDS = ("urdf", "mjcf", "isaaclab", "lerobot", "datasheet", "onnx", "ros2")


def export_run(
    run: RunLike, kind: str, out: Path | None = None, *, lerobot: Path | None = None, controller: str | None = None
) -> tuple[Path, str]:
    """Export a run as one of `KINDS`; returns the file and a sentence about it.

    ``controller``: by default what the run recommends. FileError or InputError for missing inputs.
    """
    about = Run.open(run)
    about = replace(about, arm=laden(about))
    if kind not in KINDS:
        raise InputError(f"--format {kind!r}: expected {', '.join(KINDS)}")
    for name, given, kinds in (("--lerobot", lerobot, ("lerobot",)), ("--controller", controller, ("onnx", "ros2"))):
        if given is not None and kind not in kinds:
            raise InputError(f"{name} is for --format {' and '.join(kinds)}, not for {kind}")
    if kind == "datasheet":
        require("rejoint export --format datasheet", "report")
        from rejoint.pages.report.page import write_datasheet

        path, told = write_datasheet(about.path, out or about.path / "datasheet.html"), "One page; print it on A4."
    elif kind == "lerobot":
        path, told = _lerobot(about, lerobot, out)
    elif kind in _SIMULATORS:
        require(f"rejoint export --format {kind}", "train", "jinja2")
        if (twin := about.twin) is None:
            raise FileError(about.folder.twin, "no such file", f"make it with: rejoint identify {about.path}")
        template, name = _SIMULATORS[kind]
        path = out or about.path / name.format(about.arm.name)
        write_text(path, f"{model_text(template, _unit(about), twin)}\n")
        told = "The servos are those of the twin; a comment says what the simulator lacks."
    elif kind == "urdf":
        found, rigid = _rigid(about)
        path = out or about.path / f"{about.arm.name}.urdf"
        note = (
            f"This unit as calibrated on {found.date} from {found.points} measurements ({found.source}): zeros and "
            "links are in the joint origins, with the mean effect of play and flex in postures loaded as the rest "
            "posture. In others play and flex change sides, and the description may be nearer."
        )
        write_urdf(path, unit_arm(about.arm, rigid), note)
        told = "The corrections are in the joint origins, for postures loaded as the rest posture; others may be worse."
    else:
        path, told = _controller(about, kind, out, controller)
    return path, f"{told} {quick_note(about)}".rstrip()


def _rigid(run: Run) -> tuple[Calibration, Displacement]:
    found = as_calibration(None, run, run.arm)
    if found is None:
        raise FileError(run.folder.calibration, "no such file", f"make it with: rejoint calibrate ROBOT {run.path}")
    if not found.used:
        raise FileError(
            run.folder.calibration,
            "correcting by it does not clearly help, so there is nothing to export",
            "measure more points",
        )
    rigid = found.displacement.rigid(run.arm, posture_grid(run.arm, 3).q)
    told = found.sigma("offset") <= 2.0 * OFFSET  # points see no last joint's turn
    return found, replace(rigid, offset=rigid.offset * told)


def _unit(run: Run) -> Arm:
    found = as_calibration(None, run, run.arm)
    return run.arm if found is None or not found.used else unit_arm(run.arm, _rigid(run)[1])


def _lerobot(run: Run, source: Path | None, out: Path | None) -> tuple[Path, str]:
    path, told, kept = out or run.path / "lerobot.json", "", None
    servos = {*run.arm.servos}
    if servos != FEETECH and (servos or not (source or run.gains)):
        has = ", ".join(sorted(servos)) or "none in its description (if it has them, give --lerobot FILE)"
        raise InputError(f"lerobot is for servos STS3215, and {run.arm.name} has {has}; --format urdf is for any arm")
    try:
        kept = gains_to_keep(run)
    except (FileError, InputError) as error:
        if source is None:
            raise InputError(f"lerobot needs the arm's calibration file: --lerobot FILE ({error})") from error
    if source is not None:
        motors, changes = corrected_homing(source, run.arm, _rigid(run)[1].offset)
        if path.exists() and path.samefile(source):
            raise InputError(f"{path} is the file that is read; name another one to write")
        write_homing(path, motors)
        counts = ", ".join(f"{name} {change:+d}" for name, change in changes.items())
        told = f"Homing offsets changed by {counts} counts (position = raw - homing_offset). Then calibrate again. "
    if kept is not None:
        beside = path if source is None else path.with_stem(f"{path.stem}-gains")
        # one register of two bytes: the limit of the I part is the upper one
        force = {"Minimum_Startup_Force": np.array(kept["startup"]) + 256 * np.array(kept["limit"])}
        values = {name: kept[ours] for name, ours in _GAINS.items()} | force
        joints = enumerate(run.arm.joint_names)
        write_homing(beside, {joint: {name: int(one[i]) for name, one in values.items()} for i, joint in joints})
        told += f"{beside.name} holds gains: LeRobot sets its own as it connects, so write these to the bus afterwards."
    return path, told.rstrip()


FEETECH = {"STS3215"}
"""Servos that have these registers"""
_GAINS = {
    "P_Coefficient": "p",
    "I_Coefficient": "i",
    "D_Coefficient": "d",
    "CW_Dead_Zone": "dead_cw",
    "CCW_Dead_Zone": "dead_ccw",
}
"""LeRobot's names of registers (its ``STS_SMS_SERIES_CONTROL_TABLE``), and ours"""


def _controller(run: Run, kind: str, out: Path | None, wanted: str | None) -> tuple[Path, str]:
    """Write a controller and its LEAPP description (version 1.3, ``.yaml``), alone or in a package for ROS 2."""
    require(f"rejoint export --format {kind}", "train")
    from onnx import helper

    from rejoint.pages.html import templates
    from rejoint.runs.controllergraph import controller_graph, memory_slots

    name, why = ControllerMaker(run.arm, run=run).choice() if wanted is None else (wanted, "as asked for")
    design = design_of(run, name)
    if wanted is not None and design.instead:
        raise InputError(f"--controller {wanted}: cannot be written; the run's {design.name} can")
    # lower case, digits and underscores
    package = "rejoint_" + "".join(letter if letter.isalnum() else "_" for letter in run.arm.name.lower())
    place = out or run.path / ("ros2" if kind == "ros2" else "controller.onnx")
    path = place / package / "controller.onnx" if kind == "ros2" else place
    if path.suffix != ".onnx":
        raise InputError(f"{path}: expected a file that ends with .onnx")
    model = controller_graph(design.arm, design.law, design.network)
    notice = f"{design.instead} {OUTSIDE}".strip()
    helper.set_model_props(model, metadata(design, notice))
    data = model.SerializeToString()
    sizes = memory_slots(run.arm.joints).items()
    words = {
        "design": design,
        "notice": notice,
        "package": package,
        "file": path.name,
        "md5": hashlib.md5(data, usedforsecurity=False).hexdigest(),
        "sha256": hashlib.sha256(data).hexdigest(),
        "slots": [one if size == 1 else f"{one}[{k}]" for one, size in sizes for k in range(size)],
    }
    write_bytes(path, data)
    write_text(path.with_suffix(".yaml"), render("export/controller.yaml.txt", **words))
    if kind == "ros2":
        for template in templates(ROS2):
            file = template.removeprefix(ROS2).removesuffix(".txt").replace("PACKAGE", package)
            write_text(place / file, f"{render(template, **words)}\n".lstrip())
        if (unit := _unit(run)) is not run.arm:
            told = "This unit: the corrections are in the joint origins."
            write_urdf(place / f"urdf/{run.arm.name}.urdf", unit, told)
    return place, (
        f"Controller: {name} ({why}). What is written is the {design.name}; {path.with_suffix('.yaml').name} describes "
        f"it. {notice}"
    )


ROS2 = "export/ros2/"
"""Templates of a package"""

OUTSIDE = (
    "No guard is inside: nothing limits the speed of commands, sees collisions, a hot or a stuck joint, or old joint "
    "states; the runtime must. Positions are kept within the joint limits. No calibration is inside either: the target "
    "is where the encoders are to see the tool."
)
"""Warning to the user of the file"""


class Design(NamedTuple):
    """Content of a controller's graph."""

    arm: Arm
    law: CommandLaw
    """with the anchor ``goal``"""
    network: bytes | None
    """the policy's ONNX file; None: the law alone, the feed-forward controller"""
    name: str
    periods: tuple[float, float] = (0.018, 0.055)
    """[s] shortest and longest control period"""
    gains: str = ""
    """servo gains of the training, in words, or empty"""
    instead: str = ""
    """a sentence if the run recommends another controller, else empty"""


def design_of(run: Run, best: str) -> Design:
    """Return the controller called ``best``, else the nearest of those compared that can be written.

    Without a comparison the policy, else the feed-forward. InputError for policies by the paper's recipe.
    """
    arm, name, taken, comparison = run.arm, FeedforwardController.name, inner_name(best), run.comparison
    written = (SHELF, POLICY, name)
    if taken not in written:
        rows = [row for row in (comparison.rows if comparison else ()) if inner_name(row.controller) in written]
        settled = [np.inf if row.out or row.settled is None else row.settled.mean.value for row in rows]
        taken = inner_name(rows[np.argmin(settled)].controller) if rows else POLICY
    policy = shelf_policy(arm) if taken == SHELF else run.policy if taken == POLICY else None
    if policy is None:
        twin, taken = run.twin, name
        own = FeedforwardController(arm, None if twin is None else twin.parameters.stiffness)
        law = CommandLaw(anchor="goal", stiffness=tuple(own.stiffness[0].tolist()), envelope_margin=2.0 * np.pi)
        design = Design(arm=arm, law=law, network=None, name=name)
    else:
        contract, name = policy.contract, "generic policy" if taken == SHELF else POLICY
        check_contract(contract, arm)
        if contract.law.anchor != "goal" or contract.layout != "residual":
            raise InputError(
                f"{run.folder.policy}: a law of the anchor {contract.law.anchor!r} and the layout {contract.layout!r}, "
                "expected 'goal' and 'residual'; train with the default preset"
            )
        periods, gains = (contract.min_period, contract.max_period), in_words(contract.servo_gains or {})
        design = Design(arm=arm, law=contract.law, network=policy.content, name=name, periods=periods, gains=gains)
    # a policy says which gains it is for
    if best == SHELF or name == (inner_name(best) if name == POLICY else best):
        return design
    proof = f"The run has not compared {name}."
    if comparison:
        tried = [achieves(row, comparison) for row in comparison.rows if inner_name(row.controller) == taken]
        proof = " ".join(tried) or proof
    return design._replace(instead=f"{best} cannot be written so; this is the {name} of the run instead. {proof}")


def metadata(design: Design, notice: str) -> dict[str, str]:
    """Metadata: a description, with a ``notice`` to the user."""
    return {
        "joint_names": ",".join(design.arm.joint_names),
        "rejoint.controller": design.name,
        "rejoint.arm": design.arm.name,
        "rejoint.period_s": "{:g},{:g}".format(*design.periods),
        "rejoint.memory_use": (
            "zeros begin again; where a command was limited on its way, write what was sent into the first "
            f"{design.arm.joints} entries of state_out before it goes back as state_in"
        ),
        **({"rejoint.servo_gains": design.gains} if design.gains else {}),
        "rejoint.not_inside": notice,
        "rejoint.software": __version__,
    }


DIFFERENT = 0.05
"""Share of the sag from which joints differ; chosen"""


def model_text(template: str, arm: Arm, twin: Twin) -> str:
    """Fill in a simulator's model of ``arm`` with its twin's servos."""
    from rejoint.twin.table import twin_spec

    spec, p = twin_spec(arm), twin.parameters
    bound = np.exp(twin.upper[twin.layout.at("torque_limit")])  # that of joints which no motion brought to their limit
    sag = gravity_torque(arm, posture_grid(arm, 3).q) / p.stiffness
    fed = float((p.compensation * sag**2).sum() / max((sag**2).sum(), 1e-30))  # one share of all links, by sag
    differs = np.ptp((p.compensation - fed) * sag) > DIFFERENT * np.ptp(sag)
    for joint, armature in zip(spec.joints, p.armature, strict=True):
        joint.armature = armature
    return render(
        f"export/{template}",
        arm=arm,
        twin=twin,
        p=p,
        limit=np.where(p.torque_limit < 0.99 * bound, p.torque_limit, np.inf),
        fed=fed,
        rest=(p.compensation - fed) / p.stiffness if differs else None,
        beside=back_emf(arm, p),
        inertia=1.0 / spec.compile().dof_invweight0,
        stribeck=STRIBECK_SPEED,
    )


_SIMULATORS = {"mjcf": ("mjcf.xml.txt", "{}.xml"), "isaaclab": ("isaaclab.py.txt", "isaaclab_actuators.py")}
"""Template of a model, and the name of its file"""
