"""Certified bounds of the barriers between control ticks, by interval arithmetic."""
