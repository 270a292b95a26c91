"""Random ticks of the filter, of the kinds that break filters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.properties.decision_check import POLICIES, Tick
from vcbf_drake.checks import Array
from vcbf_drake.safety import InputSet
from vcbf_drake.safety.qp import VolumeRow

MOST_INPUTS = 4
MOST_ROWS = 8

Generator = np.random.Generator
# Rows of unit length in normalised inputs, and their distances from the centre.
_Rows = tuple[Array, Array]


def random_input_set(rng: Generator) -> InputSet:
    """Returns a box, or a box with further rows, of 1 to 4 inputs in any units."""
    m = int(rng.integers(1, MOST_INPUTS + 1))
    is_box, half = bool(rng.random() < 0.6), np.ones(m)
    if rng.random() < 0.3:
        half = 10.0 ** rng.uniform(-8.0, 8.0, m if is_box else 1) * half
        half *= 10.0 ** rng.uniform(-1.0, 1.0, m)
    middle = half * rng.uniform(-2.0, 2.0, m) if rng.random() < 0.5 else np.zeros(m)
    if is_box:
        return InputSet.box(middle - half, middle + half)
    k = int(rng.integers(1, m + 3))
    normals = _directions(rng, k, m) / half
    further = rng.uniform(0.05, 1.0, k) + normals @ middle
    identity = np.eye(m)
    return InputSet(
        np.concatenate([identity, -identity, normals]),
        np.concatenate([middle + half, half - middle, further]),
    )


def random_tick(rng: Generator, input_set: InputSet, kind: str) -> Tick:
    """Returns a tick.

    Args:
        rng: The generator.
        input_set: Of any units; the rows are made for its normalised inputs.
        kind: One of `KINDS`.
    """
    m, center, scale = input_set.num_inputs, input_set.center, input_set.scale
    normals, distance = KINDS[kind](rng, m)
    normals, distance = normals[:MOST_ROWS], distance[:MOST_ROWS]
    if rng.random() < 0.3:  # Rows are in the units of their barriers.
        unit = 10.0 ** rng.uniform(-8.0, 8.0, len(distance))
        normals, distance = normals * unit[:, None], distance * unit
    A = normals / scale
    tick = Tick(
        input_set=input_set,
        A=A,
        b=distance + A @ center,
        weights=_weights(rng, len(distance)),
        volume_row=_volume_row(rng, input_set),
        reference=center + scale * _point(rng, m),
        held_input=center + scale * _point(rng, m),
        exact_slack=bool(rng.random() < 0.7),
        policy=POLICIES[int(rng.integers(len(POLICIES)))],
    )
    if kind == "not finite":
        _spoil(rng, tick)
    return tick


def _weights(rng: Generator, size: int) -> Array:
    if rng.random() < 0.7:
        return np.ones(size)
    weights: Array = 10.0 ** rng.uniform(-3.0, 3.0, size)
    return weights


def _point(rng: Generator, m: int) -> Array:
    """Inside the box, outside, at a corner, or very far away."""
    size = rng.choice([0.9, 3.0, 10.0 ** rng.uniform(0.0, 12.0)], p=[0.5, 0.35, 0.15])
    point: Array = rng.uniform(-size, size, m)
    return np.sign(point) if rng.random() < 0.1 else point


def _volume_row(rng: Generator, input_set: InputSet) -> VolumeRow | None:
    """A row in half of the ticks."""
    row = None
    # Two are drawn at times: the numbers of the examples that were found rest on it.
    for _ in range(int(rng.choice(3, p=[0.5, 0.35, 0.15]))):
        a = _directions(rng, 1, input_set.num_inputs)[0]
        size = 0.0 if rng.random() < 0.05 else 10.0 ** rng.uniform(-4.0, 3.0)
        c = size * rng.uniform(-2.0, 1.0)
        a = size * a / input_set.scale
        penalty = 10.0 ** rng.uniform(0.0, 6.0)
        row = VolumeRow(a, float(c + a @ input_set.center), float(penalty))
    return row


def _spoil(rng: Generator, tick: Tick) -> None:
    """Puts nan or an infinity into rows, reference or held input."""
    parts = [tick.A, tick.b, tick.reference, tick.held_input]
    parts = [part for part in parts if part.size]
    for _ in range(int(rng.integers(1, 4))):
        part = parts[int(rng.integers(len(parts)))]
        part.flat[int(rng.integers(part.size))] = rng.choice([np.nan, np.inf, -np.inf])


# Kinds of rows ---------------------------------------------------------------------


def _directions(rng: Generator, n: int, m: int) -> Array:
    directions = rng.standard_normal((n, m))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return directions


def _generic(rng: Generator, m: int) -> _Rows:
    n = int(rng.integers(0, MOST_ROWS + 1))
    normals, inside = _directions(rng, n, m), rng.uniform(-1.0, 1.0, m)
    return normals, normals @ inside + rng.uniform(-0.3, 1.0, n)


def _degenerate(rng: Generator, m: int) -> _Rows:
    """Many rows through one point, perhaps a corner of the box."""
    n = int(rng.integers(1, MOST_ROWS + 1))
    point = (
        rng.choice([-1.0, 0.0, 1.0], m) if rng.random() < 0.5 else rng.uniform(-1, 1, m)
    )
    normals = _directions(rng, n, m)
    if rng.random() < 0.5:
        normals = rng.integers(-2, 3, (n, m)) / 2.0
    return normals, normals @ point


def _duplicated(rng: Generator, m: int) -> _Rows:
    """Rows given twice, exactly or nearly."""
    normals, distance = _generic(rng, m)
    again = rng.integers(0, max(len(distance), 1), len(distance))
    off = 10.0 ** rng.uniform(-17.0, -6.0) * rng.standard_normal((len(again), m + 1))
    if rng.random() < 0.5:
        off[:] = 0.0
    more = normals[again] + off[:, :m], distance[again] + off[:, m]
    return _stack(rng, (normals[:4], distance[:4]), more)


def _opposite(rng: Generator, m: int) -> _Rows:
    """Slabs: thin, flat, or empty by as little."""
    n = int(rng.integers(1, 3))
    normals = _directions(rng, n, m)
    at = rng.uniform(-0.8, 0.8, n)
    gap = rng.choice([-1.0, 0.0, 1.0], n) * 10.0 ** rng.uniform(-14.0, -1.0, n)
    tilt = 10.0 ** rng.uniform(-16.0, -3.0) * rng.standard_normal((n, m))
    opposite = -normals + tilt * rng.integers(0, 2)
    slab = np.concatenate([normals, opposite]), np.concatenate([at, gap - at])
    return _stack(rng, slab, _generic(rng, m))


def _simplex(rng: Generator, m: int, size: float) -> _Rows:
    """Rows around a point, each `size` away from it; negative leaves nothing."""
    normals = _around(rng, m)
    return normals, normals @ rng.uniform(-0.8, 0.8, m) + size


def _around(rng: Generator, m: int) -> Array:
    """Directions, one more than inputs, with a positive combination that is 0."""
    directions = _directions(rng, m, m)
    last = -rng.uniform(0.2, 1.0, m) @ directions
    return np.vstack([directions, last / np.linalg.norm(last)])


def _empty(rng: Generator, m: int) -> _Rows:
    rows = _simplex(rng, m, -rng.uniform(0.01, 2.0))
    return _stack(rng, rows, _generic(rng, m))


def _nearly_empty(rng: Generator, m: int) -> _Rows:
    size = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-12.0, -3.0)
    return _stack(rng, _simplex(rng, m, size), _few_far(rng, m))


def _tiny(rng: Generator, m: int) -> _Rows:
    size = 10.0 ** rng.uniform(-9.0, -4.0)
    return _stack(rng, _simplex(rng, m, size), _few_far(rng, m))


def _few_far(rng: Generator, m: int) -> _Rows:
    normals = _directions(rng, int(rng.integers(0, 4)), m)
    return normals, rng.uniform(0.5, 2.0, len(normals))


def _huge(rng: Generator, m: int) -> _Rows:
    """Rows as far away as 1e8, on either side."""
    normals, distance = _generic(rng, m)
    far = 10.0 ** rng.uniform(0.0, 8.0, len(distance))
    return normals, distance * np.where(rng.random(len(distance)) < 0.8, far, 1.0)


def _blank(rng: Generator, m: int) -> _Rows:
    """Rows of zeros, or of next to nothing, that no input can move."""
    normals, distance = _generic(rng, m)
    blank = rng.random(len(distance)) < 0.5
    short = 10.0 ** rng.uniform(-20.0, -6.0, len(distance)) * rng.integers(0, 2)
    normals[blank] *= short[blank, None]
    distance[blank] = rng.choice([0.0, 1.0, 1.0, -1.0]) * np.abs(distance[blank])
    return normals, distance


def _nearly_parallel(rng: Generator, m: int) -> _Rows:
    normals, distance = _generic(rng, m)
    if len(distance):
        angle = 10.0 ** rng.uniform(-14.0, -3.0)
        normals = normals[0] + angle * normals
    return normals, distance


def _ties(rng: Generator, m: int) -> _Rows:
    """Small whole numbers: every coincidence that there is."""
    n = int(rng.integers(0, MOST_ROWS + 1))
    return rng.integers(-2, 3, (n, m)) / 2.0, rng.integers(-2, 4, n) / 2.0


def _stack(rng: Generator, first: _Rows, second: _Rows) -> _Rows:
    """The first rows and what there is room for of the second, in any order."""
    pairs = zip(first, second, strict=True)
    normals, distance = (np.concatenate(pair)[:MOST_ROWS] for pair in pairs)
    order = rng.permutation(len(distance))
    return normals[order], distance[order]


KINDS: dict[str, Callable[[Generator, int], _Rows]] = {
    "generic": _generic,
    "degenerate": _degenerate,
    "duplicated": _duplicated,
    "opposite": _opposite,
    "empty": _empty,
    "nearly empty": _nearly_empty,
    "tiny": _tiny,
    "huge": _huge,
    "blank rows": _blank,
    "nearly parallel": _nearly_parallel,
    "ties": _ties,
    "not finite": _generic,
}
