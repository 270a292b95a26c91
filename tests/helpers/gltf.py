"""What a glTF file holds, read without any library that draws it."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

TYPES = {5126: "<f4", 5123: "<u2"}
SIZES = {"SCALAR": 1, "VEC3": 3}


def read_gltf(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The document, and every mesh's vertices and faces, z up, by its name."""
    model = json.loads(path.read_text(encoding="utf-8"))
    (buffer,) = model["buffers"]
    content = base64.b64decode(buffer["uri"].partition(",")[2])
    assert len(content) == buffer["byteLength"]

    def array(index: int) -> Any:
        entry = model["accessors"][index]
        view = model["bufferViews"][entry["bufferView"]]
        start = view["byteOffset"]
        raw = content[start : start + view["byteLength"]]
        values = np.frombuffer(raw, TYPES[entry["componentType"]])
        return values.reshape(-1, SIZES[entry["type"]])

    meshes = {}
    for mesh in model["meshes"]:
        (part,) = mesh["primitives"]
        x, up, left = array(part["attributes"]["POSITION"]).T.astype(float)
        faces = array(part["indices"]).reshape(-1, 3)
        meshes[mesh["name"]] = np.stack([x, -left, up], axis=1), faces
    return model, meshes
