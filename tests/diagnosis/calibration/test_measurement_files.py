"""Laws of files of measurements: what goes in comes out, and what cannot be used is named."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import mycobot280, so101, tcp_position
from rejoint.diagnosis.calibration.measurements import NOISE, Measurements, read_measurements, write_measurements
from rejoint.diagnosis.calibration.procedure import suggest
from rejoint.system.errors import FileError

ARM = mycobot280()
FIELDS = ("position", "point", "sigma", "posture")


def measured(seed=0, rows=6, frame="base", source="touch"):
    rng = np.random.default_rng(seed)
    point = rng.normal(0.0, 0.2, (rows, 3))
    point[0, :2] = np.nan
    return Measurements(
        position=rng.normal(0.0, 1.0, (rows, ARM.joints)),
        point=point,
        sigma=rng.uniform(1e-4, 1e-3, rows),
        posture=np.arange(rows) // 2,
        frame=frame,
        source=source,
    )


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 30))
def test_a_file_keeps_every_bit(tmp_path_factory, seed, rows):
    path = tmp_path_factory.mktemp("files") / "m.json"
    write_measurements(path, ARM, one := measured(seed, rows, frame="room", source="camera"))
    found = read_measurements(path, ARM)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(one, name))
    assert (found.frame, found.source) == ("room", "camera")


def test_a_csv_by_hand_needs_joints_and_coordinates_alone(tmp_path):
    text = GOOD.replace("x_mm,y_mm,z", "z_mm,x_mm,y") + "\n10,20,30,40,50,60,250,100,-20\n1,2,3,4,5,6,251.5,,\n"
    (tmp_path / "hand.csv").write_text("\ufeff" + text)
    found = read_measurements(tmp_path / "hand.csv", ARM)
    np.testing.assert_allclose(found.position[0], np.radians([10, 20, 30, 40, 50, 60]))
    np.testing.assert_allclose(found.point[0], [0.1, -0.02, 0.25])
    np.testing.assert_allclose(found.point[1], [np.nan, np.nan, 0.2515])
    np.testing.assert_array_equal(found.sigma, NOISE)
    np.testing.assert_array_equal(found.posture, [0, 1])


GOOD = ",".join(f"position.{name}_deg" for name in ARM.joint_names) + ",x_mm,y_mm,z_mm"


def written(separator=",", comma=".", titles=GOOD, factor=1.0):
    rows = [titles.replace(",", separator)]
    for posture, tool in zip(PLAN, 1e3 * factor * tcp_position(ARM, PLAN), strict=True):
        cells = [f"{value:.6f}".replace(".", comma) for value in (*np.degrees(posture), *tool)]
        rows.append(separator.join(cells))
    return "\n".join(rows) + "\n"


PLAN = suggest(ARM, 4).postures


@pytest.mark.parametrize(
    "data",
    [
        written(";", ","),
        "sep=;\n" + written(";", ","),
        written("\t").encode("utf-16"),
        written("\t", ","),
        "# Monday, with the ruler\n" + written() + "# the end\n",
        written().replace("\n", ",,\n"),
        written().replace("\n", ",a note\n"),
        written(titles=GOOD.upper()),
        written(titles=GOOD.replace("_mm", " [mm]").replace("_deg", " (deg)")),
        written(titles=GOOD.replace("_mm", "_cm"), factor=0.1),
        written(titles=GOOD.replace("_mm", " [in]"), factor=1 / 25.4),
        written() + "1,2,3,4,5,6,,,\n7,8,9,10,11,12,-,-,-\n",  # two places that could not be measured
    ],
)
def test_a_csv_is_read_as_people_and_spreadsheets_write_it(tmp_path, data):
    (tmp_path / "m.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    found = read_measurements(tmp_path / "m.csv", ARM)
    np.testing.assert_allclose(found.position, PLAN, atol=1e-7)
    np.testing.assert_allclose(found.point, tcp_position(ARM, PLAN), atol=1e-6)


def test_files_of_another_arm_and_damaged_ones_are_refused(tmp_path):
    write_measurements(tmp_path / "m.json", ARM, measured())
    with pytest.raises(FileError, match="of arm mycobot280, expected so101"):
        read_measurements(tmp_path / "m.json", so101())
    data = bytearray((tmp_path / "m.json").read_bytes())
    rng = np.random.default_rng(5)
    for _ in range(40):
        flipped = bytearray(data)
        flipped[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        (tmp_path / "flipped.json").write_bytes(bytes(flipped))
        try:
            found = read_measurements(tmp_path / "flipped.json", ARM)
        except FileError:
            continue
        for name in FIELDS:  # a flip that changes nothing
            np.testing.assert_array_equal(getattr(found, name), getattr(measured(), name))
    (tmp_path / "cut.json").write_bytes(data[: len(data) // 2])
    with pytest.raises(FileError):
        read_measurements(tmp_path / "cut.json", ARM)
    with pytest.raises(FileError, match="no such file"):
        read_measurements(tmp_path / "none.csv", ARM)


def test_units_of_others_are_refused(tmp_path):
    path, degrees, tool = tmp_path / "m.csv", np.degrees(PLAN), tcp_position(ARM, PLAN)
    for joints, place, words in (
        (degrees, tool, "every coordinate of the tool is below 5; give millimetres"),
        (PLAN, 1e3 * tool, "between -3.14 and 3.14; give degrees"),
        (degrees + 300.0, 1e3 * tool, "line 2: joint1 at .* deg, expected -168 to 168"),
    ):
        np.savetxt(path, np.hstack([joints, place]), delimiter=",", header=GOOD, comments="")
        with pytest.raises(FileError, match=words):
            read_measurements(path, ARM)
