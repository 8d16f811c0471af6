"""Logs from elsewhere and back: SAGE, CSV, MCAP and LeRobot into run logs, run logs to CSV and MCAP."""

from rejoint.logs.exporting import export_log
from rejoint.logs.importing import FORMATS, Imported, detect, import_logs
from rejoint.logs.options import ANGLE_UNITS, STAMPS, TIME_UNITS, ImportOptions

__all__ = [
    "ANGLE_UNITS", "FORMATS", "STAMPS", "TIME_UNITS", "ImportOptions", "Imported", "detect", "export_log",
    "import_logs",
]  # fmt: skip
