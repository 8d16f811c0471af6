"""Foreign logs into run logs, and run logs to CSV and MCAP."""

from rejoint.logs.exclusions import unpowered_joints
from rejoint.logs.exporting import export_log
from rejoint.logs.importing import FORMATS, Imported, detect, import_logs
from rejoint.logs.joints import ANGLE_UNITS, STAMPS, TIME_UNITS, ImportOptions, read_map

__all__ = [
    "ANGLE_UNITS",
    "FORMATS",
    "STAMPS",
    "TIME_UNITS",
    "ImportOptions",
    "Imported",
    "detect",
    "export_log",
    "import_logs",
    "read_map",
    "unpowered_joints",
]
