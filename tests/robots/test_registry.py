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
    opened, opening = open_robot("x:left", seed=3)
    assert opened.text == "x:left"
    assert (opening.arm.name, opening.seed, opening.period) == ("so101", 3, (0.1, 0.1))
    with pytest.raises(InputError, match="x:left is one arm"):
        open_robot("x:left", count=2)


def test_a_broken_family_harms_no_other(install):
    install("robot-x", "x")
    install("robot-broken", "broken", "import no_such_module_of_anybody")
    assert place_of("x:1").detail == "1"
    with pytest.raises(AddressError, match=r"robot-broken 1\.2 .*ModuleNotFoundError"):
        place_of("broken:1")


def test_a_scheme_of_ours_cannot_be_taken(install):
    install("robot-thief", "tcp")
    assert place_of("tcp://robot.local").detail.host == "robot.local"
    assert "robot_thief" not in sys.modules


@pytest.mark.parametrize(
    ("address", "arm"),
    [
        ("feetech://127.0.0.1:1", "mycobot280"),
        ("tcp://127.0.0.1:1", "so101"),
        ("serial:///dev/nowhere", "so101"),
        ("emulated:koch", "so101"),
    ],
)
def test_an_arm_of_another_kind_is_refused_before_anything_is_opened(address, arm):
    with pytest.raises(InputError, match=f"this is about a {arm}; check the address"):
        open_robot(address, arm=load_arm(arm))
