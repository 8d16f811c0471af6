"""Measures the references of healthy arms that come with the package again, one for each P of `MEASURED`."""

from rejoint.arms import load_arm
from rejoint.diagnosis.healthy import AS_SOLD, MEASURED, NEW, measure_healthy, reference_path
from rejoint.system.files import write_json


def main(arm: str = "mycobot280") -> None:
    """Write the files of an arm of the catalogue."""
    known = load_arm(arm)
    for gain in MEASURED if known.name in NEW else (AS_SOLD,):
        write_json(reference_path(known, gain), measure_healthy(known, p=gain))
