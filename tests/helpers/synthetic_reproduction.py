"""A reproduction's directory made up without a simulation, every part of it there."""

from __future__ import annotations

from collections import Counter
import dataclasses
import json
import random

from tests.helpers.synthetic_results import blimp_result, car_result

SUMMARY = dict(min_barrier=0.0431, min_volume=0.0172, max_abs_slack=0.0)
COMMAND = "vcbf-drake compare {} --methods {}"
PAIR = ("dob-cbf-qp", "dob-vcbf-qp")
ESTIMATION = {
    "greatest_disturbance": 0.778,
    "greatest_error": 0.00254,
    "rms_error": 0.00181,
    "above_printed_bound": 0.873,
    "above_certified_bound": 0.0,
}


def write_reproduction(directory):
    """Writes runs/, studies/ and reproduction.json."""
    maker = Maker(directory)
    data = {
        "settings": {
            "quick": True,
            "trials": 8,
            "code": "99128a01",
            "versions": {"drake": "1.51.1"},
        },
        "verdicts": verdicts(),
        "test_1": maker.test_1(),
        "test_2": maker.test_2(),
        "test_2_explicit": maker.test_2_explicit(),
        "table_1": maker.table_1(),
        "population_blimp": maker.population_blimp(),
        "car_1": maker.car_1(),
        "car_2": maker.car_2(),
        "population_car": maker.population_car(),
        "ablation": maker.ablation(),
        "knobs": maker.knobs(),
    }
    write_data(directory, data)


def write_data(directory, data):
    """Writes reproduction.json."""
    (directory / "reproduction.json").write_text(json.dumps(data), encoding="utf-8")


def verdicts():
    claims = [
        ("CBF-QP collides", "Fig. 1(a)", "reproduced under stated conditions"),
        ("The slack is zero", "Fig. 2(b)", "reproduced"),
        ("V_v stays <higher> & above", "Fig. 2(c)", "not reproduced"),
    ]
    return [
        {
            "claim": claim,
            "where": where,
            "found": found,
            "number": f"{number}.125 s",
            "command": f"vcbf-drake run scenario-{number}",
        }
        for number, (claim, where, found) in enumerate(claims, start=71)
    ]


class Maker:
    """Saves made-up runs and trials, and returns what the numbers say of them."""

    def __init__(self, directory):
        self.directory = directory
        self.random = random.Random(7)

    def runs(self, key, results):
        entries = {}
        for result in results:
            method = result.scenario.method
            path = f"runs/{key}/{method}"
            least = {"min_barrier": round(self.random.uniform(0.01, 0.9), 3)}
            summary = result.summary | SUMMARY | least
            dataclasses.replace(result, summary=summary).save(self.directory / path)
            entries[method] = {"run": path, "summary": summary}
        return entries

    def blimps(self, key, *methods):
        return self.runs(
            key,
            [
                blimp_result(method, 6.0 + place, place == 0, seed=place)
                for place, method in enumerate(methods)
            ],
        )

    def test_1(self):
        methods = ("cbf-qp", "robust-cbf-qp", "wang-xu-dob-cbf-qp", "dob-vcbf-qp")
        winds = [
            {
                "label": f"steady, {strength} m/s^2",
                "runs": self.blimps(f"test_1_steady_{place}", *methods),
            }
            for place, strength in enumerate((0.35, 0.71), start=1)
        ]
        return {
            "description": "One sphere on the way.",
            "command": COMMAND.format("blimp-single-obstacle", ",".join(methods)),
            "runs": self.blimps("test_1", *methods),
            "steady_winds": winds,
            "estimation": ESTIMATION,
            "clearances": {
                "text": "The clearance is the caution over k2.",
                "rows": [
                    {
                        "method": method,
                        "law": "n·d / k2",
                        "least": -0.15,
                        "greatest": 0.167,
                        "integrated": None if method == "cbf-qp" else 0.123,
                        "measured": 0.111,
                    }
                    for method in methods
                ],
            },
        }

    def test_2(self):
        return {
            "description": "Spheres and weak brakes.",
            "command": COMMAND.format("blimp-multiple-obstacles", ",".join(PAIR)),
            "runs": self.blimps("test_2", *PAIR),
            "as_printed": self.blimps("test_2_as_printed", "dob-vcbf-qp"),
            "snapshots": [2.0, 5.98],
            "at_snapshots": {
                method: [
                    {
                        "time": time,
                        "volume": self.number(),
                        "reference": [self.number() for _ in range(3)],
                        "reference_is_feasible": False,
                        "input": [self.number() for _ in range(3)],
                        "input_to_nearest_face": self.number(),
                    }
                    for time in (2.0, 5.98)
                ]
                for method in PAIR
            },
            "volumes": {
                "not_lower": share(),
                "greatest_deficit": 0.3748,
                "mean_difference": 0.0475,
            },
            "interior": {method: share() for method in PAIR},
            "estimation": ESTIMATION,
        }

    def test_2_explicit(self):
        twins = {
            step: {
                "runs": self.blimps(f"test_2_{step}", *PAIR),
                "estimation": ESTIMATION,
            }
            for step in ("explicit", "implicit")
        }
        observers = [
            {"step": step, "rate": rate} | {method: self.described() for method in PAIR}
            for step, rate in (("implicit", 50.0), ("explicit", 300.0))
        ]
        return {
            "command": "vcbf-drake reproduce --only test_2_explicit",
            "description": "A counter-example.",
            "differences": "Drake integrates.",
            "observer_rate": 300.0,
            **twins,
            "observers": observers,
        }

    def car_1(self):
        methods = ("cbf-qp", "robust-cbf-qp", "dob-vcbf-qp")
        outcomes = ("collision", "timeout", "reached")
        results = [
            car_result(method, 5.0 + place, outcome)
            for place, (method, outcome) in enumerate(
                zip(methods, outcomes, strict=True)
            )
        ]
        return {
            "description": "A pushed car.",
            "command": COMMAND.format("car-avoidance", ",".join(methods)),
            "runs": self.runs("car_1", results),
        }

    def car_2(self):
        runs = {}
        for gain in (0.2, 1.0):
            results = [
                car_result(method, 5.0 + place, ("infeasible", "reached")[place])
                for place, method in enumerate(PAIR)
            ]
            runs[f"k_p={gain}"] = self.runs(f"car_2/k_p={gain}", results)
        return {
            "command": "vcbf-drake reproduce --only car_2",
            "description": "Slow and fast.",
            "gains": [0.2, 1.0],
            "runs": runs,
        }

    def study(self, name, count, methods=PAIR):
        """Random records on disk, and what a summary would count of them."""
        records = []
        for index in range(count):
            for method in methods:
                outcome = self.random.choice(["reached", "infeasible", "timeout"])
                time = 20.0 if outcome != "infeasible" else self.random.uniform(1, 19)
                records.append(
                    {
                        "index": index,
                        "method": method,
                        "outcome": outcome,
                        "running_time": time,
                        "error": None,
                    }
                )
        path = self.directory / "studies" / f"{name}.jsonl"
        path.parent.mkdir(exist_ok=True)
        path.write_text("".join(json.dumps(record) + "\n" for record in records))
        return {
            "file": f"studies/{name}.jsonl",
            "command": f"vcbf-drake monte-carlo {name}",
            "methods": {method: self.numbers(records, method) for method in methods},
            "errors": [],
        }

    def numbers(self, records, method):
        own = [record for record in records if record["method"] == method]
        mean = sum(record["running_time"] for record in own) / len(own)
        return {
            "trials": len(own),
            "outcomes": dict(Counter(record["outcome"] for record in own)),
            "mean_running_time": mean,
            "interval": [mean - 1.25, mean + 1.25],
        }

    def table_1(self):
        paper = {1: {"T1": 18.22, "T2": 10.67}, 2: {"T1": 16.21, "T2": 8.67}}
        cases = {}
        for case, times in paper.items():
            worse = [
                {"index": 3, "replay": f"vcbf-drake run --case {case} --seed 3"},
            ]
            comparison = {
                "method": "dob-vcbf-qp",
                "baseline": "dob-cbf-qp",
                "pairs": 8,
                "better": 5,
                "same": 3 - len(worse),
                "worse": len(worse),
                "worse_trials": worse if case == 1 else [],
            }
            study = self.study(f"table_1_case_{case}", 8)
            cases[f"case_{case}"] = study | {
                "paper": times,
                "comparisons": [comparison],
            }
        return {"description": "Random starts, random gains.", **cases}

    def population_blimp(self):
        return self.study("population_blimp", 12) | {
            "description": "Nobody chose these courses.",
            "generator": {
                "scenario": "blimp",
                "ranges": {"thrust [m/s^2]": [0.5, 1.5]},
            },
            "layouts": 12,
            "rates": rates(),
        }

    def population_car(self):
        return {
            "description": "Nor these.",
            "command": "vcbf-drake reproduce",
            "generator": {"scenario": "car", "ranges": {"disc radius [m]": [0.3, 0.5]}},
            "layouts": 5,
            "rates": rates(),
            "layouts_with_a_failure": {method: share() for method in PAIR},
            "by_gain": {
                str(gain): self.study(f"population_car_{gain}", 5)
                for gain in (0.2, 1.0)
            },
        }

    def ablation(self):
        return {
            "command": "vcbf-drake reproduce --only ablation",
            "description": "One correction at a time.",
            "method": "dob-vcbf-qp",
            "variants": [
                {"label": label} | self.described() | {"courses": self.described()}
                for label in ("as printed", "exact slack", "all three")
            ],
        }

    def knobs(self):
        return {
            "command": "vcbf-drake reproduce --only knobs",
            "description": "One knob at a time.",
            "lambda_Vv": self.knob("λ_Vv, the gain", "1/s", 3.0, PAIR[1:]),
            "rate": self.knob("control rate", "Hz", 50.0, PAIR),
        }

    def knob(self, label, unit, usual, methods):
        return {
            "label": label,
            "unit": unit,
            "usual": usual,
            "points": [
                {"value": value} | {method: self.described() for method in methods}
                for value in (0.5 * usual, usual, 2.0 * usual)
            ],
        }

    def described(self):
        """What a study says of one method."""
        mean, reached = 5.0 + 10.0 * self.number(), self.random.randrange(1, 9)
        return {
            "trials": 9,
            "outcomes": {"reached": reached, "infeasible": 9 - reached},
            "mean_running_time": mean,
            "interval": [mean - 1.375, mean + 1.375],
            "least_volume": self.number(),
            "greatest_slack": self.number(),
            "with_slack": share(),
        }

    def number(self):
        return self.random.uniform(0.01, 0.9)


def share():
    return {"count": 37, "of": 93, "rate": 0.3978, "interval": [0.3045, 0.4994]}


def rates():
    return {"dob-cbf-qp fails": share(), "dob-vcbf-qp fails": share() | {"count": 5}}
