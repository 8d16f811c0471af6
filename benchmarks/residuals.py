"""What is left of a real arm's motion once a twin has been fitted to other motions: what would explain it.

    python -m benchmarks.residuals LOGS [parts] [laws] [own]

LOGS as for `benchmarks.identification`; without names all three. Every motion is predicted by a fit to the other
folds, up to where the arm first touches something, so that no table is needed. `parts`: how much would be left if
one kind of error were removed perfectly. `laws`: how much if the error were a function of what the twin knows,
found by least squares on the other folds. `own`: how much if friction and offsets, or everything, were fitted to
the motion itself, and whether its first half tells them for its second.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from benchmarks import logs as sources
from rejoint.arms import Arm, Array, gravity_torque, load_arm
from rejoint.logs.exclusions import Exclusions, find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.twin.fit import Fit, Problem, fit
from rejoint.twin.holdout import folds
from rejoint.twin.judge import TIMESTEP, Candidate, predict_logs
from rejoint.twin.motionfit import LogSettings, fit_motions
from rejoint.twin.parameters import PARAMETERS, Layout, unpack
from rejoint.twin.prediction import prediction_error
from rejoint.twin.replay import Replay
from rejoint.twin.segments import free_windows
from rejoint.twin.structure import Structure

FOLDS = 4
SHORTEST = 8.0
"""[s] of motion before a first contact, below which a motion is left out (chosen: a window)"""
RIDGE = 1e-4
"""Weight of a law's coefficients beside their mean square (chosen: it keeps those apart that hardly differ)"""
BANDS = ((None, 0.05), (0.05, 0.2), (0.2, 0.7), (0.7, 2.0), (2.0, None))
"""[Hz]"""
OWN = {"offset": ("offset",), "friction": ("coulomb",), "friction and offset": ("coulomb", "offset"),
       "everything": ("stiffness", "damping", "coulomb", "armature", "offset", "delay")}  # fmt: skip
"""Parameters that a motion may have of its own"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """One motion up to its first contact, and the path of a twin that has not seen it."""

    log: RunLog
    fold: int
    path: Array
    """(T, n) [rad]"""

    @property
    def error(self) -> Array:
        """(T, n) [rad] by which it is wrong."""
        return self.path - self.log.position


def free_part(arm: Arm, logs: Sequence[RunLog]) -> list[RunLog | None]:
    """Each log up to its first row that does not show the free arm; None where that is too short."""
    found = []
    for log, rows in zip(logs, find_exclusions(arm, logs, table_height(arm, logs)), strict=True):
        end = len(log) if rows.free.all() else int(np.argmin(rows.free))
        long = end > 2 and log.time[end - 1] - log.time[0] >= SHORTEST
        found.append(log.rows(slice(0, end)) if long else None)
    return found


def fitted(arm: Arm, logs: Sequence[RunLog]) -> tuple[Fit, Structure]:
    excluded = find_exclusions(arm, logs, table_height(arm, logs))
    _, found, structure = fit_motions(arm, logs, excluded, LogSettings(threads=1))
    return found, structure


def path_of(arm: Arm, logs: Sequence[RunLog], vector: Array, structure: Structure) -> list[Array]:
    twin = Candidate(name="twin", parameters=unpack(vector, arm.joints), stiction=structure.stiction,
                     acceleration=structure.acceleration)  # fmt: skip
    return predict_logs(arm, [twin], logs)["twin"]


def predicted(arm: Arm, logs: Sequence[RunLog]) -> list[Motion]:
    number, parts, motions = folds(arm, logs, FOLDS), free_part(arm, logs), []
    for fold in range(FOLDS):
        found, structure = fitted(arm, [log for log, own in zip(logs, number, strict=True) if own != fold])
        held = [part for part, own in zip(parts, number, strict=True) if own == fold and part is not None]
        motions += [
            Motion(log=log, fold=fold, path=path)
            for log, path in zip(held, path_of(arm, held, found.vector, structure), strict=True)
        ]
    return motions


def tcp(arm: Arm, log: RunLog, path: Array) -> float:
    """Error [mm] of the tool."""
    return 1e3 * prediction_error(arm, path, log.position).tcp


def parts(arm: Arm, motions: Sequence[Motion]) -> None:
    """Remove one kind of error after the other."""

    def told(what: str, change: Callable[[Motion], Array]) -> None:
        left = [tcp(arm, m.log, change(m)) for m in motions]
        print(f"  {what:40} {np.mean(left):5.2f} mm (median {np.median(left):.2f})")

    def smooth(m: Motion, degree: int) -> Array:
        base = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(m.log)), degree)
        return m.path - base @ np.linalg.lstsq(base, m.error, rcond=None)[0]

    def shifted(m: Motion) -> Array:
        lags = np.arange(-0.04, 0.041, 0.004)
        late = np.stack([[np.interp(m.log.time + s, m.log.time, one) for one in m.path.T] for s in lags])
        best = np.argmin(((late - m.log.position.T) ** 2).mean(axis=2), axis=0)
        return np.stack([late[k, j] for j, k in enumerate(best)], axis=1)

    def without(m: Motion, low: float | None, high: float | None) -> Array:
        kind, edge = ("low", high) if low is None else ("high", low) if high is None else ("band", (low, high))
        rate = 1.0 / float(np.median(np.diff(m.log.time)))
        return m.path - sosfiltfilt(butter(2, edge, kind, fs=rate, output="sos"), m.error, axis=0, padlen=20)

    errors = {m.log.label: tcp(arm, m.log, m.path) for m in motions}
    worst = sorted(errors, key=lambda label: -errors[label])[:6]
    print("worst: " + ", ".join(f"{label} {errors[label]:.1f} mm" for label in worst))
    told("as it is", lambda m: m.path)
    for degree, what in ((0, "offset"), (1, "offset and drift"), (5, "polynomial of time, degree 5")):
        told(f"without its own {what}", lambda m, d=degree: smooth(m, d))
    told("without its own lag", shifted)
    for joint, name in enumerate(arm.joint_names):
        told(f"{name} perfect", lambda m, j=joint: np.where(np.arange(arm.joints) == j, m.log.position, m.path))
    for low, high in BANDS:
        told(f"without {low or 0:g} to {high or np.inf:g} Hz", lambda m, a=low, b=high: without(m, a, b))


def known(arm: Arm, m: Motion) -> dict[str, Callable[[int], list[Array]]]:
    """Give what the twin knows of a joint at every moment of a motion, by law."""
    time, path = m.log.time, m.path
    step = np.gradient(time)[:, None]
    speed = np.stack([np.convolve(v, np.ones(5) / 5, "same") for v in (np.gradient(path, axis=0) / step).T], axis=1)
    load = gravity_torque(arm, path)
    sign = np.where(np.abs(speed) > 0.01, np.sign(speed), 0.0)
    rows = np.maximum.accumulate(np.where(sign != 0, np.arange(len(time))[:, None], 0), axis=0)
    way = np.take_along_axis(sign, rows, axis=0)
    turned = np.maximum.accumulate(np.where(np.diff(way, axis=0, prepend=way[:1]) != 0, time[:, None], time[0]), axis=0)
    since = time[:, None] - turned
    others = np.abs(speed).sum(axis=1, keepdims=True) - np.abs(speed)
    rest, lead = np.abs(speed) < 0.02, m.log.command - path
    return {
        "nothing": lambda _: [],
        "position, two harmonics": lambda j: [f(k * path[:, j]) for k in (1, 2) for f in (np.sin, np.cos)],
        "gravity": lambda j: [load[:, j], load[:, j] ** 2],
        "direction": lambda j: [way[:, j], sign[:, j]],
        "direction and gravity": lambda j: [way[:, j], load[:, j], way[:, j] * load[:, j], way[:, j] * abs(load[:, j])],
        "direction and position": lambda j: [way[:, j] * path[:, j] ** k for k in (0, 1, 2)] + [path[:, j]],
        "speed": lambda j: [speed[:, j], np.clip(speed[:, j], -0.1, 0.1), np.clip(speed[:, j], -0.5, 0.5), way[:, j]],
        "lead of the command": lambda j: [lead[:, j], np.tanh(lead[:, j] / 0.01), np.tanh(lead[:, j] / 0.03)],
        "time since the last reversal": lambda j: [
            factor * np.exp(-since[:, j] / seconds) for seconds in (0.1, 0.5, 3.0) for factor in (1.0, way[:, j])
        ],
        "other joints move": lambda j: [
            factor * (others[:, j] > 0.1) * part for part in (1.0, rest[:, j]) for factor in (1.0, way[:, j])
        ],
        "time since the start": lambda _: [time / 60, np.exp(-(time - time[0]) / 30)],
    }  # fmt: skip


def laws(arm: Arm, motions: Sequence[Motion]) -> None:
    """Fit the error by what the twin knows, on the other folds; every motion counts the same."""
    features = [known(arm, m) for m in motions]
    for law in features[0]:
        left = {m.log.label: m.path.copy() for m in motions}
        for joint in range(arm.joints):
            design = [
                np.stack([np.ones(len(m.log)), *own[law](joint)], 1) for m, own in zip(motions, features, strict=True)
            ]
            normal = [x.T @ x / len(x) for x in design]
            moment = [x.T @ m.error[:, joint] / len(x) for x, m in zip(design, motions, strict=True)]
            for fold in range(FOLDS):
                others = [i for i, m in enumerate(motions) if m.fold != fold]
                square = np.mean([normal[i] for i in others], axis=0)
                coefficients = np.linalg.solve(
                    square + RIDGE * np.diag(np.diag(square)) + 1e-12 * np.eye(len(square)),
                    np.mean([moment[i] for i in others], axis=0),
                )
                for x, m in zip(design, motions, strict=True):
                    if m.fold == fold:
                        left[m.log.label][:, joint] -= x @ coefficients
        errors = [tcp(arm, m.log, left[m.log.label]) for m in motions]
        print(f"  {law:40} {np.mean(errors):5.2f} mm (median {np.median(errors):.2f})")


def own(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Give each motion parameters of its own, around those of a twin fitted to all of them."""
    found, structure = fitted(arm, logs)
    motions = [part for part in free_part(arm, logs) if part is not None]
    layout, x = Layout(arm.joints), found.vector

    def adapted(log: RunLog, names: tuple[str, ...]) -> Array:
        nowhere = np.zeros(len(log), dtype=bool)
        free = Exclusions(contact=nowhere, stop=nowhere, stale=nowhere)
        replay = Replay(arm, [log], free_windows([log], [free], 8.0), TIMESTEP, 1, structure.stiction,
                        acceleration=structure.acceleration)  # fmt: skip
        frozen = tuple(p.name for p in PARAMETERS if p.name not in names)
        return fit(Problem(replay, replace(structure.prior, mean=x), frozen, memory=0.2), x, 8).vector

    def error(log: RunLog, vector: Array) -> float:
        return tcp(arm, log, path_of(arm, [log], vector, structure)[0])

    halves = [(log.rows(slice(0, len(log) // 2)), log.rows(slice(len(log) // 2, None))) for log in motions]
    whole, second = [error(log, x) for log in motions], [error(late, x) for _, late in halves]
    print(
        f"  {'parameters of its own':28} fitted to it | its second half, fitted to its first ({len(motions)} motions)"
    )
    print(f"  {'none':28} {np.mean(whole):9.2f} mm | {np.mean(second):.2f} mm")
    for what, names in OWN.items():
        vectors = [adapted(log, names) for log in motions]
        here = [error(log, y) for log, y in zip(motions, vectors, strict=True)]
        there = [error(late, adapted(early, names)) for early, late in halves]
        gain = np.subtract(second, there)
        print(
            f"  {what:28} {np.mean(here):9.2f} mm | {np.mean(there):.2f} mm (better by {gain.mean():.2f}, standard "
            f"error {gain.std(ddof=1) / np.sqrt(len(gain)):.2f}; {(gain > 0).sum()} of {len(gain)} motions)",
            flush=True,
        )
        if what == "friction and offset":
            spread = np.std([y - x for y in vectors], axis=0)
            print(f"    friction differs by {np.round(100 * spread[layout.at('coulomb')]).tolist()} %, offsets by "
                  f"{np.degrees(spread[layout.at('offset')]).round(2).tolist()} deg (standard deviations)")  # fmt: skip


def main() -> None:
    """Run what is named, or everything."""
    known_parts = ("parts", "laws", "own")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path)
    parser.add_argument("what", nargs="*", metavar="|".join(known_parts))
    arguments = parser.parse_args()
    what = arguments.what or list(known_parts)
    if set(what) - set(known_parts):
        parser.error(f"{' '.join(what)}: choose from {', '.join(known_parts)}")
    arm = load_arm("so101")
    logs = sources.read(arguments.logs, arm)
    motions = predicted(arm, logs) if {"parts", "laws"} & set(what) else []
    for name in what:
        print(f"\n== {name} ==")
        if name == "own":
            own(arm, logs)
        else:
            {"parts": parts, "laws": laws}[name](arm, motions)


if __name__ == "__main__":
    main()
