"""Pictures of results, and the vehicles' geometry for Drake's visualisers.

The names below are loaded when first used: a terminal's table needs no figures.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vcbf_drake.viz.figures import write_figures
    from vcbf_drake.viz.replay import write_replay
    from vcbf_drake.viz.replay.recording import write_diagram_replay
    from vcbf_drake.viz.scene_graph import ObstacleGeometry, VehicleGeometry

_HOME = {
    "VehicleGeometry": "scene_graph",
    "ObstacleGeometry": "scene_graph",
    "write_diagram_replay": "replay.recording",
    "write_figures": "figures",
    "write_replay": "replay",
}

__all__ = [
    "ObstacleGeometry",
    "VehicleGeometry",
    "write_diagram_replay",
    "write_figures",
    "write_replay",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
