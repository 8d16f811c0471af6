"""Families of robots that other packages bring: found when asked for, and named when they cannot be used."""

import sys

import pytest

from rejoint.arms import load_arm
from rejoint.robots import Family, Place, open_robot, place_of, registry
from rejoint.system.errors import AddressError, InputError

GOOD = """
from rejoint.robots import Family
FAMILY = Family(scheme="{scheme}", form="{scheme}:NAME", parse=lambda text: text.partition(":")[2],
                connect=lambda place, opening: (place, opening), default_period=(0.1, 0.1), default_arm="so101")
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Puts packages where Python finds installed ones, without an installer."""
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = []

    def put(package, scheme, code=None):
        module = package.replace("-", "_")
        info = tmp_path / f"{module}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{scheme} = {module}:FAMILY\n")
        (tmp_path / f"{module}.py").write_text(GOOD.format(scheme=scheme) if code is None else code)
        modules.append(module)

    yield put
    for module in modules:
        sys.modules.pop(module, None)


def test_a_family_of_another_package_is_found_by_its_scheme(install):
    install("robot-x", "x")
    place = place_of("x:left")
    assert isinstance(place, Place)
    assert isinstance(place.family, Family)
    assert (place.detail, place.default_arm, place.default_period, place.virtual) == (
        "left",
        "so101",
        (0.1, 0.1),
        False,
    )
    opened, opening = place.open(seed=3)
    assert opened is place
    assert (opening.arm.name, opening.seed, opening.period) == ("so101", 3, (0.1, 0.1))
    with pytest.raises(InputError, match="x:left is one arm"):
        place.open(count=2)


def test_what_nobody_asks_for_is_not_imported(install):
    install("robot-x", "x")
    install("robot-y", "y")
    place_of("emulated:worn")
    place_of("y:1")
    assert "robot_y" in sys.modules
    assert "robot_x" not in sys.modules


def test_an_unknown_scheme_lists_the_forms_of_all_families_and_who_is_broken(install):
    install("robot-x", "x")
    install("robot-broken", "broken", "import no_such_module_of_anybody")
    with pytest.raises(AddressError) as caught:
        place_of("carrier-pigeon:1")
    line = str(caught.value)
    assert "emulated:PROFILE" in line
    assert "tcp://HOST:PORT" in line
    assert "x:NAME" in line
    assert "robot-broken 1.2" in line
    assert "no_such_module_of_anybody" in line
    assert "\n" not in line
    assert place_of("x:1").detail == "1", "the others work"
    with pytest.raises(AddressError, match=r"robot-broken 1\.2 .*ModuleNotFoundError.*update or remove it"):
        place_of("broken:1")


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("FAMILY = 3", "expected a Family of the scheme z, found a int"),
        (GOOD.format(scheme="other"), "found the family of other:"),
        ("", "AttributeError"),
        ("raise SystemError('a\\nb')", r"SystemError: a\)"),
    ],
)
def test_what_is_no_family_of_its_scheme_is_refused(install, code, says):
    install("robot-z", "z", code)
    with pytest.raises(AddressError, match=says) as caught:
        place_of("z:1")
    assert "robot-z 1.2" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bug_in_a_driver_is_named_as_its_packages(install):
    install("robot-x", "x", GOOD.format(scheme="x") + "\n\ndef step():\n    return 1 / 0\n")
    place_of("x:1")
    with pytest.raises(ZeroDivisionError) as caught:
        sys.modules["robot_x"].step()
    assert registry.driver_of(caught.value) == "the package robot-x 1.2 (driver of x:)"
    assert registry.driver_of(ValueError("of nobody's")) is None


def test_a_scheme_of_ours_cannot_be_taken(install):
    install("robot-thief", "tcp")
    assert place_of("tcp://robot.local").detail.host == "robot.local"
    assert "robot_thief" not in sys.modules
    with pytest.raises(AddressError, match=r"robot-thief 1\.2 .*refused: tcp: is one of rejoint's own schemes"):
        place_of("carrier-pigeon:1")


def test_a_scheme_that_two_packages_bring_is_refused_for_both(install):
    install("robot-a", "both", GOOD.format(scheme="both"))
    install("robot-b", "both", GOOD.format(scheme="both"))
    with pytest.raises(
        AddressError, match=r"robot-[ab] 1\.2 .*refused: the package robot-[ab] 1\.2 brings both: as well"
    ):
        place_of("both:1")
    with pytest.raises(AddressError) as caught:
        place_of("carrier-pigeon:1")
    assert str(caught.value).count("is refused") == 2


@pytest.mark.parametrize(
    ("address", "arm"),
    [("feetech://127.0.0.1:1", "mycobot280"), ("tcp://127.0.0.1:1", "so101"), ("serial:///dev/nowhere", "so101")],
)
def test_an_arm_of_another_kind_is_refused_before_anything_is_opened(address, arm):
    with pytest.raises(InputError, match=f"this is about a {arm}; check the address"):
        open_robot(address, arm=load_arm(arm))
