"""Certified bounds of the barriers between control ticks, by interval arithmetic."""

from vcbf_drake.between_ticks.backup_gate import BackupGate
from vcbf_drake.between_ticks.certified_heights import (
    certified_least_barrier,
    is_certifiable,
    known_along,
    least_height,
)
from vcbf_drake.between_ticks.held_rows import HeldRows

__all__ = [
    "BackupGate",
    "HeldRows",
    "certified_least_barrier",
    "is_certifiable",
    "known_along",
    "least_height",
]
