"""A lens: where a camera shows a point, with the distortion of Brown as OpenCV writes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.system.errors import InputError

TERMS = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
"""The numbers of a lens in the order of `Lens.numbers`"""

_UNDISTORTING = 30
"""Most steps of the search for the undistorted point (chosen)"""
_SETTLED = 1e-9  # change of a step after which the search ends: a millionth of a pixel


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A camera of square pixels, without its pose."""

    width: int
    """[px]"""
    height: int
    """[px]"""
    f: float
    """[px] focal length"""
    cx: float
    """[px] where the optical axis meets the picture"""
    cy: float
    k1: float = 0.0
    """[1] radial distortion"""
    k2: float = 0.0
    p1: float = 0.0
    """[1] tangential distortion"""
    p2: float = 0.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or not self.f > 0.0:
            raise InputError(
                f"lens: expected a picture and a focal length above 0 px, got {self.width} x {self.height}, f {self.f}"
            )

    @classmethod
    def usual(cls, width: int, height: int) -> Lens:
        """Return the lens to begin with for pictures of a size: a web camera's, 70 degrees wide."""
        return cls(width=width, height=height, f=0.72 * width, cx=0.5 * (width - 1), cy=0.5 * (height - 1))

    @property
    def numbers(self) -> Array:
        """(7,) its `TERMS`."""
        return np.array([getattr(self, name) for name in TERMS])

    def with_numbers(self, numbers: Array) -> Lens:
        """Return a lens of the same picture with other `TERMS` (7,)."""
        return Lens(
            width=self.width, height=self.height, **dict(zip(TERMS, map(float, numbers), strict=True))
        )  # fmt: skip

    def project(self, point: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) [m] in the frame of the camera, in front of it."""
        return projected(self.numbers, point)[0]

    def rays(self, pixel: Array) -> Array:
        """Points (..., 2) at distance 1 along the optical axis that the camera shows at ``pixel`` (..., 2)."""
        wanted = (pixel - [self.cx, self.cy]) / self.f
        ray = np.array(wanted)
        for _ in range(_UNDISTORTING):
            radial, tangential = _distortion(self.numbers, ray)
            before, ray = ray, (wanted - tangential) / radial
            if np.abs(ray - before).max(initial=0.0) < _SETTLED:
                break
        return ray

    def shows(self, pixel: Array, margin: float = 0.0) -> Array:
        """Tell which pixels (..., 2) lie in the picture, by ``margin`` [px] at least; returns (...)."""
        size = np.array([self.width, self.height]) - 1.0
        return np.asarray(((pixel >= margin) & (pixel <= size - margin)).all(axis=-1))


def projected(numbers: Array, point: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of points (..., 3) [m], with derivatives by point (..., 2, 3) and by `TERMS` (..., 2, 7)."""
    f, cx, cy, k1, k2, p1, p2 = numbers
    depth = point[..., 2]
    ray = point[..., :2] / depth[..., None]
    x, y = ray[..., 0], ray[..., 1]
    radial, tangential = _distortion(numbers, ray)
    bent = ray * radial + tangential
    square = x**2 + y**2
    growth = 2.0 * k1 + 4.0 * k2 * square
    by_ray = np.empty((*x.shape, 2, 2))
    by_ray[..., 0, 0] = radial[..., 0] + growth * x**2 + 2.0 * p1 * y + 6.0 * p2 * x
    by_ray[..., 1, 1] = radial[..., 0] + growth * y**2 + 6.0 * p1 * y + 2.0 * p2 * x
    by_ray[..., 0, 1] = by_ray[..., 1, 0] = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    by_point = np.empty((*x.shape, 2, 3))
    by_point[..., :2] = f * by_ray / depth[..., None, None]
    by_point[..., 2] = -(by_point[..., :2] @ ray[..., None])[..., 0]
    by_terms = np.zeros((*x.shape, 2, len(TERMS)))
    by_terms[..., 0] = bent
    by_terms[..., 0, 1] = by_terms[..., 1, 2] = 1.0
    by_terms[..., 3] = f * square[..., None] * ray
    by_terms[..., 4] = f * square[..., None] ** 2 * ray
    by_terms[..., 0, 5] = by_terms[..., 1, 6] = 2.0 * f * x * y
    by_terms[..., 1, 5] = f * (square + 2.0 * y**2)
    by_terms[..., 0, 6] = f * (square + 2.0 * x**2)
    return f * bent + np.array([cx, cy]), by_point, by_terms


def _distortion(numbers: Array, ray: Array) -> tuple[Array, Array]:
    """Radial factor (..., 1) and tangential shift (..., 2) of undistorted points (..., 2)."""
    k1, k2, p1, p2 = numbers[3:]
    x, y = ray[..., 0], ray[..., 1]
    square = x**2 + y**2
    shift = np.stack([2 * p1 * x * y + p2 * (square + 2 * x**2), p1 * (square + 2 * y**2) + 2 * p2 * x * y], axis=-1)
    return (1.0 + k1 * square + k2 * square**2)[..., None], shift
