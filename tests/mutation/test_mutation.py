"""The mutants that mutation testing makes, of sources small enough to read."""

from tests.mutation.mutants import mutants


def changes(source):
    return [(m.before, m.after) for m in mutants(source, "source.py")]


def test_a_comparison_is_shifted_and_turned():
    assert changes("a < b") == [("a < b", "a <= b"), ("a < b", "a > b")]
    assert changes("a is b") == [("a is b", "a is not b")]


def test_operators_numbers_and_signs():
    assert changes("a + 2") == [("a + 2", "a - 2"), ("2", "3")]
    assert changes("-a") == [("-a", "a")]
    assert changes("0.5") == [("0.5", "1.0")]
    assert changes("1e-9") == [("1e-09", "1.0000000000000002e-06")]
    assert changes("True") == [("True", "False")]


def test_calls_and_statements():
    assert changes("f(a, b)") == [("f(a, b)", "pass"), ("f(a, b)", "f(b, a)")]
    assert changes("x = max(a, b)") == [("max", "min")]
    assert changes("x[i] = y") == [("x[i] = y", "pass")]
    assert changes("x = y") == []  # Without it nothing runs at all.
    source = "def f(a):\n    if a:\n        return a"
    assert changes(source) == [("if a:", "if not a:"), ("return a", "return None")]


def test_texts_and_annotations_are_left_alone():
    assert changes('def f(a: "x" = None) -> "y":\n    """Text."""') == []
    assert changes("@dataclass(frozen=True)\nclass A:\n    x: int") == []


def test_only_one_fault_at_a_time_and_the_code_runs():
    source = "def f(a, b):\n    return a - b if a > b else b - a"
    answers = []
    for mutant in mutants(source, "source.py"):
        names = {}
        exec(mutant.code, names)
        answers.append((names["f"](3, 5), names["f"](5, 3)))
    assert answers == [(None, None), (2, 2), (-2, -2), (2, 8), (8, 2)]
