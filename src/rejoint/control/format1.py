"""Policies whose contract has format 1 (rejoint 0.1.0 before its second one): arms they can still be checked for.

That contract told geometry and joint limits of its arm, and not the masses, the rest posture and the target region that
its law computes with. For an arm of the catalogue those are known: they are the ones of that version.
"""

from __future__ import annotations

from typing import NamedTuple

from rejoint.system.errors import ContractError


class CatalogueArm(NamedTuple):
    """An arm as the catalogue had it then."""

    geometry: str
    """its digest in format 1"""
    digests: dict[str, str]
    """by field, as `rejoint.control.contract.law_digests` gives them"""


ARMS = {
    "mycobot280": CatalogueArm(
        geometry="f382bddea59dce3b",
        digests={
            "offset": "041f687116d49dd1", "axis": "ced5b88ecbb703c1", "tip": "7ed532836d7106ed",
            "mass": "c5983c5f26d6ab8a", "com": "dcaab8af9e9a4b25", "rest": "a5705d2f90d2d968",
            "targets": "917d0001737460db",
        },
    ),
    "so101": CatalogueArm(
        geometry="f43b8d4c7691f1ca",
        digests={
            "offset": "4ee046714aeaf049", "axis": "e6b475edbf78e1ca", "tip": "ac387094a4d9e7cb",
            "mass": "160d46a49f896de5", "com": "95274c1ba7e6fda6", "rest": "eb26e4ad9c120ebf",
            "targets": "10f7fe765d3dd394",
        },
    ),
}  # fmt: skip


def arm_of_format_1(name: object, geometry: object) -> dict[str, str]:
    """Return the digests by field of the arm that a contract of format 1 names; ContractError where none is known."""
    known = ARMS.get(name) if isinstance(name, str) else None
    if known is None or known.geometry != geometry:
        raise ContractError(
            "the policy's contract has format 1, which does not tell for which masses and rest posture it was trained; "
            "train it again"
        )
    return dict(known.digests)
