"""What each correction of the published method buys."""

from __future__ import annotations

from typing import Any

from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import Records, Section, text
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, describe
from vcbf_drake.studies.reproduction.table_1 import paired_trials
from vcbf_drake.studies.trial import Record
from vcbf_drake.studies.variation import BLIMP_COURSES, TABLE_I, Courses, Variation

SCENARIO = "blimp-multiple-obstacles"

# Label and the corrections that are on.
_VARIANTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "paper": ("as printed", ()),
    "exact_slack": ("exact slack", ("exact_slack",)),
    "total_derivative": ("total derivative", ("total_derivative",)),
    "error_floor": ("error floor", ("error_floor",)),
    "exact_slack_total_derivative": (
        "exact slack, total derivative",
        ("exact_slack", "total_derivative"),
    ),
    "all": ("all three", ("exact_slack", "total_derivative", "error_floor")),
}
_DRAWS: dict[str, Variation | Courses] = {
    "starts": TABLE_I[1],
    "courses": BLIMP_COURSES,
}


def ablation(settings: Settings) -> Section:
    """Returns the section: sets of corrections, on Test 2's trials and on courses."""
    studies = {
        _file(variant, draws): paired_trials(
            SCENARIO,
            settings.ablation_trials,
            variation,
            text(_overrides(variant)),
            methods=(WITH,),
        )
        for variant in _VARIANTS
        for draws, variation in _DRAWS.items()
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        variants = [
            {
                "name": variant,
                "label": label,
                "overrides": text(_overrides(variant)),
                **describe(records[_file(variant, "starts")], WITH),
                "courses": describe(records[_file(variant, "courses")], WITH),
            }
            for variant, (label, _) in _VARIANTS.items()
        ]
        return {
            "description": _DESCRIPTION,
            "method": WITH,
            "variants": variants,
        }

    return Section("ablation", evaluate, studies=studies)


def _file(variant: str, draws: str) -> str:
    return f"ablation_{variant}_{draws}"


def _overrides(variant: str) -> dict[str, Any]:
    return {"corrections": dict.fromkeys(_VARIANTS[variant][1], True)}


_DESCRIPTION = (
    "dob-vcbf-qp with each correction alone and with several, from Table I's random"
    " starts on Test 2's course, and over the first of the random courses, where"
    " not every run succeeds."
)
