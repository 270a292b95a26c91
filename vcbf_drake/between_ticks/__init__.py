"""Certified bounds of the barriers between control ticks, by interval arithmetic."""

from vcbf_drake.between_ticks.held_rows import HeldRows, least_height

__all__ = ["HeldRows", "least_height"]
