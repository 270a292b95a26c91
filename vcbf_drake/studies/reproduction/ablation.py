"""What each correction of the published method buys."""

from __future__ import annotations

from collections.abc import Sequence
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
_STARTS = TABLE_I[1]


def ablation(settings: Settings) -> Section:
    """Returns the section: sets of corrections, on Test 2's trials and on courses."""
    trials = [
        trial
        for variant in _VARIANTS
        for draws in (_STARTS, BLIMP_COURSES)
        for trial in paired_trials(
            SCENARIO,
            settings.ablation_trials,
            draws,
            text(_overrides(variant)),
            methods=(WITH,),
        )
    ]

    def evaluate(archive: Archive, records: Records) -> Record:
        variants = [
            {
                "name": variant,
                "label": label,
                "overrides": text(_overrides(variant)),
                **_describe(records["ablation"], variant, _STARTS),
                "courses": _describe(records["ablation"], variant, BLIMP_COURSES),
            }
            for variant, (label, _) in _VARIANTS.items()
        ]
        return {
            "description": _DESCRIPTION,
            "method": WITH,
            "variants": variants,
        }

    return Section("ablation", evaluate, studies={"ablation": trials})


def _describe(
    records: Sequence[Record], variant: str, draws: Variation | Courses
) -> Record:
    wanted = text(_overrides(variant)), draws.name
    own = [r for r in records if (r["overrides"], r["variation"]) == wanted]
    return describe(own, WITH)


def _overrides(variant: str) -> dict[str, Any]:
    return {"fidelity": dict.fromkeys(_VARIANTS[variant][1], True)}


_DESCRIPTION = (
    "dob-vcbf-qp with each correction alone and with several, from Table I's random"
    " starts on Test 2's course, and over the first of the random courses, where"
    " not every run succeeds."
)
