"""Figure 2: seven spheres and weak reverse thrust."""

from __future__ import annotations

from vcbf_drake.studies.reproduction.judgements.finding import Data, Finding
from vcbf_drake.studies.reproduction.judgements.numbers import summary_of
from vcbf_drake.studies.reproduction.judgements.words import ending, proportion
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT


def only_proposed_arrives(data: Data) -> Finding:
    """Figure 2(a): the proposed filter arrives, the one without volume row stops."""
    runs = data["test_2"]["runs"]
    own, other = summary_of(runs, WITH), summary_of(runs, WITHOUT)
    number = (
        f"{WITHOUT} {ending(other)}, {other['final_distance']:.1f} m from the target;"
        f" {WITH} {ending(own)}"
    )
    holds = own["outcome"] == "reached" and other["outcome"] == "infeasible"
    if "population_blimp" not in data:
        return Finding(holds, True, number)
    rates = data["population_blimp"]["rates"]
    stops, arrives = (
        rates["dob-cbf-qp fails"],
        rates["of its failures, dob-vcbf-qp reaches"],
    )
    return Finding(
        holds,
        stops["rate"] == arrives["rate"] == 1.0,
        f"{number}. Over random courses {WITHOUT} fails in {proportion(stops)};"
        f" of these {WITH} arrives in {proportion(arrives)}",
    )


def slack_is_zero(data: Data) -> Finding:
    """Figure 2(b): the slack is zero all along."""
    own = summary_of(data["test_2"]["runs"], WITH)["max_abs_slack"]
    printed = summary_of(data["test_2"]["as_printed"], WITH)["max_abs_slack"]
    return Finding(
        own == 0.0,
        printed == 0.0,
        f"at most {own:.2g} with the exact slack,"
        f" {printed:.2g} with the printed penalty",
    )


def volume_is_higher(data: Data) -> Finding:
    """Figure 2(c): V_v of the proposed filter is always the higher."""
    volumes = data["test_2"]["volumes"]
    return Finding(
        volumes["greatest_deficit"] == 0.0,
        True,
        f"not lower at {proportion(volumes['not_lower'])} of the common ticks, higher"
        f" by {volumes['mean_difference']:.3f} on average, lower by up to"
        f" {volumes['greatest_deficit']:.3f}",
    )


def only_the_other_set_vanishes(data: Data) -> Finding:
    """Figure 2(f), (g): without the volume row the feasible set vanishes."""
    own, other = (data["test_2"]["at_snapshots"][m][-1] for m in (WITH, WITHOUT))
    stopped = summary_of(data["test_2"]["runs"], WITHOUT)["outcome"] == "infeasible"
    return Finding(
        stopped and own["volume"] > 0.0,
        True,
        f"one tick before {WITHOUT} ends, at {other['time']:.2f} s, V_v is"
        f" {own['volume']:.3f} with and {other['volume']:.3f} without the volume row",
    )


def proposed_maps_to_the_interior(data: Data) -> Finding:
    """Figure 2(d)-(g): the proposed filter maps to the interior, the other does not."""
    own, other = (data["test_2"]["at_snapshots"][m][0] for m in (WITH, WITHOUT))
    inside, boundary = (data["test_2"]["interior"][m] for m in (WITH, WITHOUT))
    distances = own["input_to_nearest_face"], other["input_to_nearest_face"]
    return Finding(
        distances[0] > 1e-6 >= distances[1],
        inside["rate"] == 1.0 and boundary["rate"] == 0.0,
        f"at {own['time']:.0f} s {distances[0]:.2f} and {distances[1]:.2f} from the"
        f" nearest face; inside at {proportion(inside)} of all ticks with a reference"
        f" outside, against {proportion(boundary)}",
    )


def volume_stays_positive(data: Data) -> Finding:
    """Theorem 2: V_v >= 0 along the run."""
    main = summary_of(data["test_2"]["runs"], WITH)["min_volume"]
    number = f"least V_v {main:.3f} in Test 2"
    beside = []
    for name, numbers in _studies(data):
        least = numbers["methods"][WITH]["least_volume"]
        beside.append(least is None or least >= 0.0)
        number += f", {least:.3f} over {name}"
    return Finding(main >= 0.0, all(beside), number)


def _studies(data: Data) -> list[tuple[str, Data]]:
    found = []
    if "table_1" in data:
        found += [
            ("Table I's starts", data["table_1"]["case_1"]),
            ("its gains", data["table_1"]["case_2"]),
        ]
    if "population_blimp" in data:
        found.append(("random courses", data["population_blimp"]))
    return found
