from __future__ import annotations

from collections.abc import Callable
import inspect
import os
from pathlib import Path
import subprocess
from subprocess import PIPE
import sys

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.symbolic import Expression, Variable, atan2, if_then_else, sin, sqrt
import pytest

import vcbf_drake.model.code_cache as code_cache
from vcbf_drake.model.code_cache import cache_directory, store_code
from vcbf_drake.model.compiled import compile_expressions
from vcbf_drake.model.generated_code import is_arithmetic

x, y = Variable("x"), Variable("y")
EXPRESSIONS = [sqrt(x * x + y * y) / 3.0, atan2(y, x) + sin(x) ** 2 * 0.1]
POINT = (0.3, -0.7)
# Computed without any code of the package.
VALUES = [e.Evaluate({x: POINT[0], y: POINT[1]}) for e in EXPRESSIONS]

# Says what a shipped scenario's rows are, to the last bit, and whether SymPy was used.
ROWS = """
import sys
import numpy as np
from vcbf_drake import load_scenario, make_loop
loop = make_loop(load_scenario("car-avoidance"))
rows = loop.GetSubsystemByName("filter").barrier_set.rows
for x in np.random.default_rng(0).normal(size=(20, 4)):
    found = rows(x, 0.5)
    for numbers in (found.A, found.b, found.w, found.A_gradient, found.b_gradient):
        print(numbers.tobytes().hex())
print("sympy" in sys.modules)
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "cache"
    monkeypatch.setenv("VCBF_DRAKE_CACHE", str(directory))
    return directory


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collects the code that had to be written anew."""
    codes: list[str] = []

    def store(key: str, code: str) -> None:
        codes.append(code)
        store_code(key, code)

    monkeypatch.setattr("vcbf_drake.model.compiled.store_code", store)
    return codes


def compiled() -> Callable[..., list[float]]:
    return compile_expressions([x, y], EXPRESSIONS, "example")


def start(cache: str, seed: str = "0") -> subprocess.Popen[str]:
    environment = os.environ | {"VCBF_DRAKE_CACHE": cache, "PYTHONHASHSEED": seed}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    return subprocess.Popen(
        [sys.executable, "-c", ROWS], env=environment, stdout=PIPE, text=True
    )


def rows_and_sympy(process: subprocess.Popen[str]) -> tuple[list[str], bool]:
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    *rows, used = output.split()
    return rows, used == "True"


# Hits --------------------------------------------------------------------------------


def test_other_processes_start_without_sympy_and_get_the_same_bits(
    tmp_path: Path,
) -> None:
    """Two cold starts at once, then a warm one, against one without any cache."""
    cache = str(tmp_path / "cache")
    both = [start(cache, seed) for seed in ("1", "2")]
    results = [rows_and_sympy(process) for process in both]
    files = {path: path.read_bytes() for path in Path(cache).iterdir()}
    results.append(rows_and_sympy(start(cache, "3")))
    results.append(rows_and_sympy(start("off", "4")))
    assert len({tuple(rows) for rows, _ in results}) == 1
    assert results[2][1] is False and results[3][1] is True
    # Nothing half written is left, nothing was written again.
    assert {path.suffix for path in files} == {".py"}
    assert {path: path.read_bytes() for path in Path(cache).iterdir()} == files


def test_a_hit_is_the_same_code(cache: Path, written: list[str]) -> None:
    first, second = compiled(), compiled()
    assert len(written) == 1
    assert inspect.getsource(first) == inspect.getsource(second) == written[0]
    assert first(*POINT) == second(*POINT)
    assert second.__name__ == "example"
    np.testing.assert_allclose(second(*POINT), VALUES, rtol=1e-14)


@pytest.mark.parametrize("name", ["a + 1", "a"])
def test_equal_names_and_their_history_do_not_matter(
    cache: Path, written: list[str], name: str
) -> None:
    older, newer = Variable(name), Variable(name)
    for a, b in ((older, newer), (newer, older)):
        renamed = {x: Expression(a), y: Expression(b)}
        function = compile_expressions(
            [a, b], [e.Substitute(renamed) for e in EXPRESSIONS]
        )
        np.testing.assert_allclose(function(*POINT), VALUES, rtol=1e-14)
    assert len(written) == 1


def test_a_name_that_reads_like_a_formula_is_no_formula(cache: Path) -> None:
    product = Variable("x * y")
    assert compile_expressions([x, y, product], [product])(2.0, 3.0, 5.0) == [5.0]
    assert compile_expressions([x, y, product], [x * y])(2.0, 3.0, 5.0) == [6.0]


@pytest.mark.parametrize(
    ("variables", "expression"),
    [
        ([y, x], x - y),
        ([x, y], x - 2 * y),
        ([x, y, Variable("z")], x - y),
        ([x, y], (1 + 2**-52) * x - y),
        ([x, y], if_then_else(x > 0.1, x - y, y)),
        ([x, y], if_then_else(x > 0.1 + 2**-55, x - y, y)),
        ([x, y], if_then_else(x >= 0.1, x - y, y)),
    ],
)
def test_other_content_is_other_code(
    cache: Path, written: list[str], variables: list[Variable], expression: Expression
) -> None:
    compile_expressions([x, y], [x - y])
    compile_expressions([x, y], [if_then_else(x > 0.1 + 2**-56, x - y, y)])
    compile_expressions(variables, [expression])
    assert len(written) == 3


def test_another_generator_or_python_is_other_code(
    cache: Path, written: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled()
    monkeypatch.setattr(code_cache, "installed_version", lambda name: f"{name} 99")
    compiled()
    monkeypatch.setattr(sys, "version", "4.0")
    compiled()
    assert len(written) == 3


# Files that hold something else ------------------------------------------------------


def with_checksum(file: Path, code: str) -> str:
    return f"{code_cache._header(file.stem, code)}\n{code}"


FORGED = "def f(a0, a1):\n    return [a0.__class__, print('run')]\n"


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: "",
        lambda file: file.read_text()[:-1],
        lambda file: file.read_text()[:70],
        lambda file: file.read_text() + "\n",
        lambda file: file.read_text().replace("a0", "a1"),
        lambda file: file.read_text().replace(file.stem, "0" * 64),
        lambda file: file.read_text().partition("\n")[2],
        lambda file: "\0\ud800",
        lambda file: FORGED,
        lambda file: with_checksum(file, FORGED),
        lambda file: with_checksum(file, "import os\n" + file.read_text()),
        lambda file: with_checksum(file, "(" * 1000),
    ],
)
def test_another_files_content_is_ignored_and_replaced(
    cache: Path,
    written: list[str],
    damage: Callable[[Path], str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    expected = compiled()(*POINT)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(file).encode(errors="surrogatepass"))
    assert compiled()(*POINT) == expected
    assert capsys.readouterr().out == ""
    assert file.read_bytes() == whole and len(written) == 2
    compiled()
    assert len(written) == 2


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_any_damage_is_ignored(cache: Path, data: st.DataObject) -> None:
    compiled()
    (file,) = cache.iterdir()
    content = bytearray(file.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at:] = data.draw(st.binary(max_size=4)) + content[at + 1 :]
    file.write_bytes(content)
    np.testing.assert_allclose(compiled()(*POINT), VALUES, rtol=1e-14)


@pytest.mark.parametrize(
    "line",
    [
        "import os",
        "return __import__('os')",
        "return [().__class__]",
        "return [a0.real]",
        "return [a0[0]]",
        "return [(lambda: a0)()]",
        "return [(abs if a0 else max)(a0)]",
        "return [open(a0)]",
        "return ['text']",
        "return [x for x in a0]",
        "return f'{a0}'",
        "global abs",
        "while a0: pass",
        "return [(x := a0)]",
        "def g(): return [a0]",
        "yield a0",
    ],
)
def test_code_that_does_more_than_arithmetic_is_told(line: str) -> None:
    assert is_arithmetic("def f(a0):\n    x = sin(a0)**2\n    return [x]\n")
    assert not is_arithmetic(f"def f(a0):\n    {line}\n")
    assert not is_arithmetic(f"{line}\ndef f(a0):\n    return [a0]\n")


@pytest.mark.parametrize("code", ["", "1", "(", "\0", "@abs\n{}", "{}f(1)\n", "{}{}"])
def test_only_one_function_is_arithmetic(code: str) -> None:
    function = "def f(a0):\n    return [a0]\n"
    assert is_arithmetic(function)
    assert not is_arithmetic(code.format(function, function))


# Places ------------------------------------------------------------------------------


def test_the_place_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VCBF_DRAKE_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert cache_directory() == Path("/home/somebody/.cache/vcbf_drake")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # The standard: ignore it.
    assert cache_directory() == Path("/home/somebody/.cache/vcbf_drake")
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert cache_directory() == Path("/elsewhere/vcbf_drake")
    monkeypatch.setenv("VCBF_DRAKE_CACHE", "~/mine")
    assert cache_directory() == Path("/home/somebody/mine")
    monkeypatch.setenv("VCBF_DRAKE_CACHE", "off")
    assert cache_directory() is None


def test_without_a_place_to_write_everything_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "locked").mkdir(mode=0o500)
    for place in ("file", "file/below", "locked", "locked/below", "off"):
        where = place if place == "off" else str(tmp_path / place)
        monkeypatch.setenv("VCBF_DRAKE_CACHE", where)
        np.testing.assert_allclose(compiled()(*POINT), VALUES, rtol=1e-14)


def test_a_failed_write_leaves_nothing(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", full)
    np.testing.assert_allclose(compiled()(*POINT), VALUES, rtol=1e-14)
    assert list(cache.iterdir()) == []


def test_the_oldest_files_go(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_cache, "_MOST_FILES", 4)
    for age in range(5):
        compile_expressions([x], [x * float(age + 2)])
        (newest,) = [file for file in cache.iterdir() if file.stat().st_mtime > 1e9]
        os.utime(newest, (age, age))
    assert sorted(file.stat().st_mtime for file in cache.iterdir()) == [3.0, 4.0]
