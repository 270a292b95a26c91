"""Geofences, against the distances to their sides."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from vcbf_drake.barriers import BarrierSet, Geofence
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, Car

K = (3.0, 2.0)


def test_values_are_the_distances_to_the_sides() -> None:
    car = ControlAffineModel.from_system(Car())
    fence = Geofence([-1.0, -2.0], [4.0, 3.0], margin=0.25)
    barriers = BarrierSet(car, fence.barriers(K))
    assert barriers.names == tuple(
        f"geofence ({side})" for side in ("x low", "x high", "y low", "y high")
    )
    x = np.array([1.0, -3.0, 0.5, 0.1])
    assert_allclose(barriers.values(x, 0.0), [1.75, 2.75, -1.25, 5.75])
    heading = np.array([np.cos(0.1), np.sin(0.1)])
    rows = barriers.rows(x, 0.0)
    speeds = np.array([heading[0], -heading[0], heading[1], -heading[1]]) * 0.5
    assert_allclose(rows.b, 3.0 * speeds + 2.0 * rows.value)


def test_infinite_sides_are_open() -> None:
    blimp = ControlAffineModel.from_system(Blimp())
    fence = Geofence([-np.inf, -np.inf, 0.5], [np.inf, np.inf, 2.0])
    barriers = BarrierSet(blimp, fence.barriers(K, name="room"))
    assert barriers.names == ("room (z low)", "room (z high)")
    assert_allclose(barriers.values(np.full(8, 0.75), 0.0), [0.25, 1.25])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0], [1.0]), r"2 or 3 numbers each, got shapes \(1,\) and \(1,\)"),
        (([0.0, 0.0], [1.0, 1.0, 1.0]), "2 or 3 numbers each"),
        (([0.0, 0.0], [1.0, 0.0]), "upper must be above lower"),
        (([0.0, 0.0], [1.0, np.nan]), "upper must be above lower"),
        (([0.0, 0.0], [1.0, 1.0], 0.5), "more than twice the margin"),
        (([0.0, 0.0], [1.0, 1.0], -0.5), "margin: -0.5"),
        (([-np.inf] * 2, [np.inf] * 2), "at least one side must be finite"),
    ],
)
def test_bad_geofences_are_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=f"^geofence: .*{message}"):
        Geofence(*arguments)
