"""Draws the block diagrams of this directory from the shipped scenarios.

python diagrams/make.py [DIRECTORY]
"""

from pathlib import Path
import sys

from two_processes import hardware_dot

from vcbf_drake import load_scenario, make_loop
from vcbf_drake.hil import InProcess
from vcbf_drake.viz.block_graph import write_dot
from vcbf_drake.viz.diagram import write_diagram


def make(directory: Path) -> None:
    """Writes every DOT file, and every SVG where Graphviz is installed."""
    for name in ("car-avoidance", "blimp-multiple-obstacles"):
        loop = make_loop(load_scenario(name))
        write_diagram(loop, directory, name)
    both = InProcess(load_scenario("blimp-multiple-obstacles"))
    write_dot(hardware_dot(both, "two-processes"), directory, "two-processes")
    write_diagram(loop.GetSubsystemByName("filter"), directory, "safety-filter")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent)
