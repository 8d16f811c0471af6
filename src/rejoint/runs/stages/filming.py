"""Filming: pictures of a board in many postures of an arm, kept as they come, and what they told as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Arm
from rejoint.arms.camera.rigfile import write_rig
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under
from rejoint.diagnosis.calibration.camera.film import Film
from rejoint.diagnosis.calibration.camera.filmfile import POSTURES, read_film, write_film, write_postures
from rejoint.diagnosis.calibration.camera.filming import CameraGauge, FilmDrive, Picture, UnseenBoardError
from rejoint.runs.run import Run
from rejoint.runs.stages.known import guard_limits, stance_of
from rejoint.runs.stages.measuring import log_resumed, same
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import set_aside, write_whole
from rejoint.system.progress import Progress

if TYPE_CHECKING:
    from rejoint.diagnosis.calibration.camera.fit import Filmed
    from rejoint.twin.twin import Twin

QUALITY = 92
"""of the pictures that are kept, as JPEG counts it (chosen: half a megabyte; corners are found before)"""


def film_of(
    robot: Robot, gauge: CameraGauge, run: Run | None, twin: Twin | None, count: int, visits: int,
    on_progress: Progress, *, afresh: bool = False,
) -> Film:  # fmt: skip
    """Take the film of an open robot; in a run, go on with the one that was interrupted there, unless ``afresh``."""
    arm = robot.arm
    begun = None if run is None else interrupted(run, gauge, afresh=afresh)
    film = begun or Film(board=gauge.board, carried=gauge.carried, afresh=afresh)
    if begun is None:
        _set_aside(run)
    elif run is not None:
        log_resumed(run.folder.views, f"{len(film)} pictures are there")

    def keep(film: Film, name: str, picture: Picture) -> None:
        if run is not None:
            write_picture(run.folder.pictures / name, picture)
            write_film(run.folder.views, arm, film)

    with gauge.camera(robot) as camera:
        drive = FilmDrive(
            robot=robot, camera=camera, film=film,
            limits=limits_under(guard_limits(run, arm, robot.address), robot, None), stance=stance_of(twin, run),
            on_shot=keep, on_progress=on_progress,
        )  # fmt: skip
        try:
            return drive.take(count, visits)
        except UnseenBoardError:  # camera or board will be moved, so nothing of this belongs to what comes
            _set_aside(run)
            raise
        except BaseException as error:
            if run is not None and run.folder.views.exists():
                file, goes_on = run.folder.views, same(afresh=film.afresh)
                error.add_note(f"What was seen until then is kept ({file}); {goes_on} goes on there")
            raise


def _set_aside(run: Run | None) -> None:
    """Make room for a new film; the old one keeps its time as its name."""
    if run is not None:
        set_aside(run.folder.views)
        set_aside(run.folder.pictures)


def interrupted(run: Run, gauge: CameraGauge, *, afresh: bool) -> Film | None:
    """Return what the film of a run that was interrupted holds already; None where a new one begins."""
    if afresh or not run.folder.views.exists():
        return None
    film, ended = read_film(run.folder.views, run.arm)
    if ended:
        return None
    if film.board != gauge.board or film.carried != gauge.carried:
        raise InputError(
            f"{run.folder.views}: an interrupted session with another board, or with the board elsewhere; give "
            "the same again, or begin anew with --afresh"
        )
    return film.again()


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture as JPEG; FileError where that fails."""
    import cv2

    good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not good:
        raise FileError(path, "this picture cannot be written as JPEG", "take another camera")
    write_whole(path, lambda temporary: temporary.write_bytes(data.tobytes()))


def write_filmed(run: Run, arm: Arm, film: Film, found: Filmed, *, taken: bool) -> None:
    """Write what goes with a calibration by camera: the ended film, the postures of its pictures, and the rig.

    ``taken``: the film was taken in this run; else its pictures lie elsewhere.
    """
    if taken:
        write_postures(run.folder.pictures / POSTURES, arm, film)
    else:
        set_aside(run.folder.views)
    write_film(run.folder.views, arm, film, ended=True)
    set_aside(run.folder.camera)
    write_rig(run.folder.camera, arm, found.rig, found.rig_sigma, found.calibration.date)
