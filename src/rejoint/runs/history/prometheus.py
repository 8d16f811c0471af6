"""A check as a text file that Prometheus' node exporter picks up."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from rejoint.diagnosis.monitoring.judge import Outlook
from rejoint.diagnosis.monitoring.measures import CheckMeasures
from rejoint.system.files import write_whole

_STATES = ("learning", "steady", "drifting", "alarm")


def write_prometheus(path: Path, name: str, seen: Outlook, measures: CheckMeasures) -> None:
    """Write the check of the arm ``name`` into ``path``, whole or not at all; FileError if it cannot."""
    text = prometheus_text(name, seen, measures)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def prometheus_text(name: str, seen: Outlook, measures: CheckMeasures) -> str:
    """Return the metrics of a check in Prometheus' text format; times are seconds since 1970."""
    arm = f'arm="{_escaped(name)}"'
    lines: list[str] = []

    def metric(name: str, what: str, values: list[tuple[str, float]]) -> None:
        if values:
            lines.extend((f"# HELP rejoint_{name} {what}", f"# TYPE rejoint_{name} gauge"))
            lines.extend(f"rejoint_{name}{{{labels}}} {value:.10g}" for labels, value in values)

    metric("state", "1 for the state that the arm is in", [
        (f'{arm},state="{state}"', float(seen.state == state)) for state in _STATES
    ])  # fmt: skip
    known = "tool" if seen.error_known else "encoders"
    metric("error_mm", "tool error at the five poses of a check", [(f'{arm},by="{known}"', seen.error_mm)])
    metric("controlled_error_mm", "tool error with the controller of the last repair, at most",
           [] if seen.controlled_mm is None else [(arm, seen.controlled_mm)])  # fmt: skip
    metric("tolerance_mm", "tool error that the owner can bear",
           [] if seen.tolerance_mm is None else [(arm, seen.tolerance_mm)])  # fmt: skip
    metric("repeatability_mm", "largest RP of a pose by the encoders", [(arm, measures.repeatability_mm)])
    if seen.due is not None:
        ends = (("early", seen.due.early), ("middle", seen.due.middle), ("late", seen.due.late))
        metric("due_seconds", "when the tolerance will be reached",
               [(f'{arm},end="{end}"', _seconds(time)) for end, time in ends if time is not None])  # fmt: skip
    metric("hysteresis_mm", "following error one way minus the other", [
        (f'{arm},joint="{_escaped(row.joint)}"', row.hysteresis_mm) for row in measures.joints
    ])  # fmt: skip
    metric("cusum", "standard deviations that have come together since the change began", [
        (f'{arm},joint="{_escaped(one.joint)}",quantity="{one.quantity}"', one.cusum) for one in seen.changes
    ])  # fmt: skip
    return "\n".join([*lines, ""])


def _seconds(time: datetime) -> float:
    return (time - datetime(1970, 1, 1)).total_seconds()


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
