"""Where a training leaves its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Outputs:
    """Files of a training in the folder ``out`` that it was given, such as a run folder."""

    out: Path

    @property
    def policy(self) -> Path:
        """The trained policy with its contract."""
        return self.out / "policy.onnx"

    @property
    def folder(self) -> Path:
        """What a training needs on its way, and its curves."""
        return self.out / "training"

    @property
    def curves(self) -> Path:
        """Parquet, one row per update, the fields of `CurvePoint`."""
        return self.folder / "curves.parquet"

    @property
    def checkpoint(self) -> Path:
        """What an interrupted training goes on from."""
        return self.folder / "checkpoint.pt"

    def snapshot(self, updates: int) -> Path:
        """Path of the policy kept after so many updates."""
        return self.folder / f"policy-{updates:04}.onnx"
