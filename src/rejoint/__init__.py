"""Give a worn robot arm its accuracy back, in software.

The stages of a repair as functions (`repair` is all of them), the objects that they take and return, and the errors
that they raise. Each name is loaded at its first use. Positions are in radians, lengths in metres, times in seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rejoint.arms.arm import Arm
    from rejoint.arms.draft import Loaded
    from rejoint.arms.loading import load_arm, read_arm
    from rejoint.control.comparison.recommend import Recommendation
    from rejoint.control.comparison.result import Comparison
    from rejoint.control.controllers.policy import Policy
    from rejoint.control.deployment import Deployed
    from rejoint.control.moving.drive import Followed
    from rejoint.control.moving.reference import Path, Stream
    from rejoint.control.recording import Observer
    from rejoint.control.robot import Controller, Robot
    from rejoint.control.targets import Pose
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.diagnosis.calibration.measurements import Measurements
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.logs.runlog import RunLog
    from rejoint.pages.live.view import LiveView
    from rejoint.robots import open_robot
    from rejoint.runs.repair import RepairPlan, Session, Stage, connect, repair, report
    from rejoint.runs.run import Run
    from rejoint.runs.stages.calibrate import Calibrated, calibrate
    from rejoint.runs.stages.check import Checked, CheckNotes, check
    from rejoint.runs.stages.compare import Compared, TrialPlan, compare
    from rejoint.runs.stages.diagnose import Diagnosed, diagnose
    from rejoint.runs.stages.gains import gains
    from rejoint.runs.stages.identify import LogPlan, Replayed, identify, replay
    from rejoint.runs.stages.train import TrainedPolicy, TrainSettings, train
    from rejoint.session.inputs import Settings
    from rejoint.session.motions import deploy, follow
    from rejoint.session.serving import Serving, serve
    from rejoint.session.session import ArmState
    from rejoint.system.errors import (
        AddressError,
        ConnectionLostError,
        ContractError,
        FileError,
        GuardTripError,
        ImpossibleReplyError,
        InputError,
        MissingExtraError,
        NoReplyError,
        NotReachedError,
        NotReadyError,
        PowerLostError,
        ProfileError,
        RejointError,
        RobotError,
        StaleReplyError,
        UnsavedError,
    )
    from rejoint.system.progress import Progress
    from rejoint.system.shell import __version__
    from rejoint.system.stopping import Interrupted, interrupt
    from rejoint.twin.twin import Judgement, Twin

_HOMES = {
    "arms.arm": ("Arm",),
    "arms.draft": ("Loaded",),
    "arms.loading": ("load_arm", "read_arm"),
    "control.robot": ("Controller", "Robot"),
    "control.moving.drive": ("Followed",),
    "control.moving.reference": ("Path", "Stream"),
    "control.recording": ("Observer",),
    "control.controllers.policy": ("Policy",),
    "control.targets": ("Pose",),
    "diagnosis.calibration.calibration": ("Calibration",),
    "diagnosis.calibration.measurements": ("Measurements",),
    "diagnosis.diagnosis": ("Diagnosis",),
    "logs.runlog": ("RunLog",),
    "control.comparison.recommend": ("Recommendation",),
    "control.comparison.result": ("Comparison",),
    "control.deployment": ("Deployed",),
    "pages.live.view": ("LiveView",),
    "robots": ("open_robot",),
    "runs.repair": ("RepairPlan", "Session", "Stage", "connect", "repair", "report"),
    "runs.run": ("Run",),
    "runs.stages.calibrate": ("Calibrated", "calibrate"),
    "runs.stages.check": ("CheckNotes", "Checked", "check"),
    "runs.stages.compare": ("Compared", "TrialPlan", "compare"),
    "runs.stages.diagnose": ("Diagnosed", "diagnose"),
    "runs.stages.gains": ("gains",),
    "runs.stages.identify": ("LogPlan", "Replayed", "identify", "replay"),
    "runs.stages.train": ("TrainSettings", "TrainedPolicy", "train"),
    "session.motions": ("deploy", "follow"),
    "session.serving": ("Serving", "serve"),
    "session.session": ("ArmState",),
    "session.inputs": ("Settings",),
    "system.errors": (
        "AddressError", "ConnectionLostError", "ContractError", "FileError", "GuardTripError",
        "ImpossibleReplyError", "InputError", "MissingExtraError", "NoReplyError", "NotReachedError",
        "NotReadyError", "PowerLostError", "ProfileError", "RejointError", "RobotError", "StaleReplyError",
        "UnsavedError",
    ),
    "system.progress": ("Progress",),
    "system.stopping": ("Interrupted", "interrupt"),
    "system.shell": ("__version__",),
    "twin.twin": ("Judgement", "Twin"),
}  # fmt: skip
"""Where each public name is defined"""

_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "AddressError", "Arm", "ArmState", "Calibrated", "Calibration", "CheckNotes", "Checked", "Compared",
    "Comparison", "ConnectionLostError", "ContractError", "Controller", "Deployed", "Diagnosed", "Diagnosis",
    "FileError", "Followed", "GuardTripError", "ImpossibleReplyError", "InputError", "Interrupted", "Judgement",
    "LiveView", "Loaded", "LogPlan", "Measurements", "MissingExtraError", "NoReplyError", "NotReachedError",
    "NotReadyError", "Observer", "Path", "Policy", "Pose", "PowerLostError", "ProfileError", "Progress",
    "Recommendation", "RejointError", "RepairPlan", "Replayed", "Robot", "RobotError", "Run", "RunLog",
    "Serving", "Session", "Settings", "Stage", "StaleReplyError", "Stream", "TrainSettings", "TrainedPolicy",
    "TrialPlan", "Twin", "UnsavedError", "__version__", "calibrate", "check", "compare", "connect", "deploy",
    "diagnose", "follow", "gains", "identify", "interrupt", "load_arm", "open_robot", "read_arm", "repair",
    "replay", "report", "serve", "train",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value  # the next time it is found at once
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
