"""The report: one self-contained HTML page, and its figures as PNG files, from a run folder."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import jinja2

from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.pages.report.contents import Contents, read_contents
from rejoint.pages.report.embed import theme_css
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import UNKNOWN
from rejoint.pages.report.sections import accuracy, compared, diagnosed, motion, training, trust, twin
from rejoint.pages.report.sections.details import commands, details_section
from rejoint.pages.report.sections.verdict import page_of
from rejoint.pages.report.view import Page, Section
from rejoint.system.files import write_whole
from rejoint.system.version import __version__
from rejoint.twin.parameters import prior
from rejoint.twin.unknown import unknown_prior


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/*.png`` into a run folder and return the page's path.

    Reads only files of the folder; stages that have not been run are named on the page. FileError if
    a file is damaged or if nothing has been run.
    """
    contents = read_contents(folder)
    gallery = Gallery()
    html = render(make_page(contents, gallery))
    gallery.save(contents.folder.figures)
    write_whole(contents.folder.report, lambda temporary: temporary.write_text(html, encoding="utf-8"))
    return contents.folder.report


def render(page: Page) -> str:
    """Fill the template."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rejoint.pages.report", "."), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("page.html").render(page=page, theme=theme_css(), unknown=UNKNOWN)


def make_page(contents: Contents, gallery: Gallery) -> Page:
    """Build everything that the template shows."""
    advice = None if contents.comparison is None else recommend(contents.comparison)
    sections = (
        _comparison(contents, advice, gallery),
        _accuracy(contents, gallery),
        _motion(contents, gallery),
        _diagnosis(contents, gallery),
        *_trust(contents, gallery),
        _twin(contents, gallery),
        _training(contents, gallery),
        details_section(contents),
    )
    sections = tuple(sorted(sections, key=lambda section: bool(section.missing)))  # stable: what is there comes first
    return page_of(contents, advice, sections, footer=f"Made by rejoint {__version__} from {contents.folder.path}.")


def _comparison(contents: Contents, advice: Recommendation | None, gallery: Gallery) -> Section:
    if contents.comparison is None or advice is None:
        return _missing(compared, "The controllers have not been compared yet", contents, "compare")
    healthy = None if contents.diagnosis is None else diagnosed.healthy_error(contents.diagnosis)
    return compared.comparison_section(contents.comparison, advice.controller, healthy, gallery)


def _accuracy(contents: Contents, gallery: Gallery) -> Section:
    if contents.calibration is None:
        return _missing(accuracy, "Nobody has measured where the tool is", contents, "calibrate")
    return accuracy.accuracy_section(contents.calibration, contents.measurements, gallery)


def _motion(contents: Contents, gallery: Gallery) -> Section:
    if not contents.crossing and not contents.hold:
        return _missing(motion, "No run log of a trial is here yet", contents, "compare")
    return motion.motion_section(contents.arm, contents.crossing, contents.hold, gallery)


def _diagnosis(contents: Contents, gallery: Gallery) -> Section:
    if contents.diagnosis is None:
        return _missing(diagnosed, "The arm has not been diagnosed yet", contents, "diagnose")
    return diagnosed.diagnosis_section(contents.diagnosis, gallery, twin=contents.twin is not None)


def _missing(section: ModuleType, what: str, contents: Contents, stage: str) -> Section:
    """Keep the place of a section whose ``stage`` has not been run."""
    how = commands(contents)[stage].line
    return Section(key=section.KEY, short=section.SHORT, heading=section.HEADING, missing=f"{what}. To do it: {how}")


def _twin(contents: Contents, gallery: Gallery) -> Section:
    if contents.twin is None:
        return _missing(twin, "No twin has been identified yet", contents, "identify")
    belief = prior(contents.arm) if contents.judgement is None else unknown_prior(contents.arm)
    return twin.twin_section(contents.twin, belief, gallery, kept=str(contents.kept or ""))


def _trust(contents: Contents, gallery: Gallery) -> tuple[Section, ...]:
    if contents.judgement is None:  # only a twin from logs is judged beside others
        return ()
    return (trust.trust_section(contents.judgement, gallery),)


def _training(contents: Contents, gallery: Gallery) -> Section:
    if contents.curves is None and contents.contract is None:
        return _missing(training, "No policy has been trained yet", contents, "train")
    return training.training_section(contents.curves, contents.contract, gallery)
