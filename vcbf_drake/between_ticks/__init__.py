"""Certified bounds of the barriers between control ticks, by interval arithmetic."""

from vcbf_drake.between_ticks.backup_gate import BackupGate
from vcbf_drake.between_ticks.held_rows import HeldRows, least_height

__all__ = ["BackupGate", "HeldRows", "least_height"]
