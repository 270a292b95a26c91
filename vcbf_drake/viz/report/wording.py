"""Numbers and outcomes in words, the same way everywhere in the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import re
from typing import Any

from vcbf_drake.viz.report.reproduction import in_drawing_order
from vcbf_drake.viz.style import METHOD_STYLES

NOTHING = "–"
_MINUS = re.compile(r"(?<!\w)-(?=\d)")


def fixed(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals; a dash where there is none."""
    if value is None:
        return NOTHING
    # No zero with a minus sign, and a true minus before the others.
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def significant(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; a dash where there is none."""
    return NOTHING if value is None else f"{value:.{digits}g}"


def slack(value: float | None) -> str:
    """A slack; 0 only where it is exactly that."""
    return "0" if value == 0.0 else significant(value, 2)


def between(interval: Sequence[float] | None, digits: int = 2) -> str:
    """An interval; a dash where there is none."""
    if interval is None:
        return NOTHING
    return f"{fixed(interval[0], digits)} to {fixed(interval[1], digits)}"


def percent(share: float | None) -> str:
    """A share in percent."""
    return NOTHING if share is None else f"{100.0 * share:.1f} %"


def section_command(key: str) -> str:
    """What makes a section's numbers, where no shorter command does."""
    return f"vcbf-drake reproduce --only {key}"


def method_label(method: str) -> str:
    """A method's name as people read it."""
    return METHOD_STYLES[method].label


def readable(label: str) -> str:
    """A label that was typed in plain letters, as it is set."""
    return _MINUS.sub("−", label.replace("^2", "²").replace("=", " = "))


def listed(words: Sequence[str]) -> str:
    """Words with commas and an `and`."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def ending(summary: Mapping[str, Any]) -> str:
    """How a run ended, as what follows the method's name."""
    match summary["outcome"]:
        case "reached":
            return f"reaches the target at {fixed(summary['reached_at'], 1)} s"
        case "collision":
            return f"collides at {fixed(summary['collided_at'], 1)} s"
        case "infeasible":
            return f"has no feasible input at {fixed(summary['infeasible_at'])} s"
        case _:
            away = fixed(summary["final_distance"])
            return f"stays feasible and ends {away} m from the target"


def endings(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """How every run ended, as a sentence."""
    parts = [
        f"{method_label(method)} {ending(run['summary'])}"
        for method, run in in_drawing_order(runs).items()
    ]
    return "; ".join(parts) + "."


def least_barriers(runs: Mapping[str, Mapping[str, Any]], unit: str) -> str:
    """The least barrier of every run."""
    return ", ".join(
        f"{method_label(method)} {fixed(run['summary']['min_barrier'], 4)} {unit}"
        for method, run in in_drawing_order(runs).items()
    )
