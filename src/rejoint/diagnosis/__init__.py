"""What is wrong with an arm: excitation, measurements per joint, and a verdict in words."""

from rejoint.diagnosis.diagnosis import Diagnosis, diagnose, judge
from rejoint.diagnosis.evidence import Evidence
from rejoint.diagnosis.excitation import FULL, SHORT, Excitation, Plan, plan_excitation
from rejoint.diagnosis.fromlogs import diagnose_logs
from rejoint.diagnosis.healthy import HealthyReference, healthy_reference, load_healthy, reference_from
from rejoint.diagnosis.measurement import JointMetrics, Measurement, measure
from rejoint.diagnosis.open_loop import OpenLoop, TargetError, open_loop_errors
from rejoint.diagnosis.record import EXCITATION_LABEL, TARGETS_LABEL, DiagnosisLogs, record
from rejoint.diagnosis.segments import ExcitationLog, Segment, attach_segments
from rejoint.diagnosis.verdict import Finding
from rejoint.system.statistics import Estimate

__all__ = [
    "EXCITATION_LABEL", "FULL", "SHORT", "TARGETS_LABEL", "Diagnosis", "DiagnosisLogs", "Estimate", "Evidence",
    "Excitation", "ExcitationLog", "Finding", "HealthyReference", "JointMetrics", "Measurement", "OpenLoop", "Plan",
    "Segment", "TargetError", "attach_segments", "diagnose", "diagnose_logs", "healthy_reference",
    "judge", "load_healthy", "measure", "open_loop_errors", "plan_excitation", "record", "reference_from",
]  # fmt: skip
