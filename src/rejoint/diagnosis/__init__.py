"""Diagnosis: excitation, measurements per joint, verdict."""
