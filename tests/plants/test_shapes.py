"""Parts of bodies: their extent, and the models that come with the package."""

from __future__ import annotations

from importlib.resources import files
import json
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Capsule, HalfSpace, Sphere
from pydrake.math import RigidTransform, RotationMatrix
import pytest

from tests.helpers.gltf import read_gltf
from vcbf_drake.plants import BlimpVehicle, CarVehicle
from vcbf_drake.plants.shapes import Part, bounding_box, painted_model

MODELS = Path(str(files("vcbf_drake") / "models"))
TRUE_SIZE = {"blimp": [0.81, 0.54, 0.595], "car": [0.422, 0.224, 0.153]}


@pytest.mark.parametrize("name", TRUE_SIZE)
def test_a_models_surface_is_sound(name: str) -> None:
    model, meshes = read_gltf(MODELS / f"{name}.gltf")
    assert sum(m["name"] == "paint" for m in model["materials"]) >= 1
    for vertices, faces in meshes.values():
        assert np.all(np.isfinite(vertices))
        assert set(np.unique(faces)) == set(range(len(vertices)))
    points = np.vstack([vertices for vertices, _ in meshes.values()])
    np.testing.assert_allclose(np.ptp(points, axis=0), TRUE_SIZE[name], atol=2e-3)


def test_the_car_stands_on_the_ground_and_the_blimp_hangs_around_its_centre() -> None:
    low, _ = bounding_box(CarVehicle().geometry("#000000"))
    assert low[2] == pytest.approx(0.0, abs=1e-6)
    low, high = bounding_box(BlimpVehicle().geometry("#000000"))
    assert low[1] == pytest.approx(-high[1])


def test_the_envelope_has_the_volume_of_the_air_it_displaces() -> None:
    _, meshes = read_gltf(MODELS / "blimp.gltf")
    volume = 0.0
    for name in ("envelope", "nose", "tail"):
        vertices, faces = meshes[name]
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume += np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0  # Divergence theorem.
    ellipsoid = 4.0 / 3.0 * np.pi * 0.385 * 0.255**2
    assert volume == pytest.approx(ellipsoid, rel=0.05)


def test_paint_has_the_colour_asked_for_as_glTF_has_it() -> None:
    source = painted_model("car", "#ff8000").source()
    model = json.loads(source.in_memory().mesh_file.contents())
    colors = {
        material["name"]: material["pbrMetallicRoughness"]["baseColorFactor"]
        for material in model["materials"]
    }
    # 128/255 of sRGB is 0.2159 of the light.
    assert colors["paint"] == pytest.approx([1.0, 0.2159, 0.0, 1.0], abs=1e-4)
    assert colors["wheels"][0] < 0.03


def test_boxes_around_drakes_shapes() -> None:
    turn = RigidTransform(RotationMatrix.MakeZRotation(np.pi / 2), [1.0, 0.0, 0.0])
    parts = [
        Part("ball", Sphere(0.5), "#000000"),
        Part("box", Box(0.2, 2.0, 0.4), "#000000", turn),
        Part("ground", HalfSpace(), "#000000"),
    ]
    low, high = bounding_box(parts)
    np.testing.assert_allclose(low, [-0.5, -0.5, -0.5], atol=1e-12)
    np.testing.assert_allclose(high, [2.0, 0.5, 0.5], atol=1e-12)
    low, high = bounding_box([Part("pill", Capsule(0.1, 1.0), "#000000")])
    np.testing.assert_allclose([low[2], high[2]], [-0.6, 0.6])
    assert [corner.tolist() for corner in bounding_box([])] == [[0.0] * 3] * 2
