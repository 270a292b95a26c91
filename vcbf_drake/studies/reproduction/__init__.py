"""Every figure and table of the paper: what is run, and what it says."""

from vcbf_drake.studies.reproduction.results import RESULTS, SECTIONS, reproduce
from vcbf_drake.studies.reproduction.settings import FULL, QUICK, Settings

__all__ = ["FULL", "QUICK", "RESULTS", "SECTIONS", "Settings", "reproduce"]
