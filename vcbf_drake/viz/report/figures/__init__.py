"""Figures of many runs side by side, which only the report shows."""
