"""The report of a reproduction: one HTML page, and its numbers as Markdown."""

from vcbf_drake.viz.report.write_report import reproduction_markdown, write_report

__all__ = ["reproduction_markdown", "write_report"]
