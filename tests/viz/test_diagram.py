"""Block diagrams against Drake's own account of the same diagrams."""

from __future__ import annotations

from collections import Counter
import html
from itertools import pairwise
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

import pydot
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    Gain,
    Integrator,
    LogVectorOutput,
    VectorLogSink,
)
import pytest

from vcbf_drake import Blimp, load_scenario, make_loop
from vcbf_drake.viz.diagram import diagram_dot, filter_dot, write_diagram

# pydot's parser still calls pyparsing by its old names.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:pydot")

LOOKS_ON = VectorLogSink
DIAGRAMS = Path(__file__).parents[2] / "diagrams"
LOOPS = {
    "blimp": ("blimp-multiple-obstacles", {}),
    "car": ("car-avoidance", {}),
    "no estimate": ("car-avoidance", {"method": "cbf-qp"}),
    "noise": ("car-avoidance", {"noise": {"std": [0.01, 0.01, 0.01, 0.01]}}),
}
COMMITTED = (
    "blimp-multiple-obstacles",
    "car-avoidance",
    "safety-filter",
    "two-processes",
)

BUNDLED = "bundled"  # In the place of a size.

Connection = tuple[str, str, str, str, str]


@pytest.fixture(scope="module")
def blimp_loop() -> Diagram:
    return make_loop(load_scenario("blimp-multiple-obstacles"))


@pytest.fixture(scope="module")
def blimp_dot(blimp_loop: Diagram) -> str:
    return diagram_dot(blimp_loop)


@pytest.fixture(scope="module", params=LOOPS)
def drawn(request: pytest.FixtureRequest) -> tuple[Diagram, str]:
    """A loop and its DOT text."""
    name, overrides = LOOPS[request.param]
    diagram = make_loop(load_scenario(name, overrides))
    return diagram, diagram_dot(diagram)


def parsed(dot: str) -> pydot.Dot:
    graphs = pydot.graph_from_dot_data(dot)
    assert graphs is not None and len(graphs) == 1
    return graphs[0]


def port_names(graph: pydot.Dot) -> dict[str, dict[str, str]]:
    """Every block's port identifiers with the names written at them."""
    cell = r'PORT="(\w+)"><FONT[^>]*>(.*?)</FONT>'
    return {
        node.get_name().strip('"'): {
            port: html.unescape(text).strip("\N{NO-BREAK SPACE}")
            for port, text in re.findall(cell, node.get("label"))
        }
        for node in graph.get_nodes()
        if node.get("label") and "<TABLE" in node.get("label")
    }


def drawn_connections(dot: str) -> Counter[Connection]:
    """Every arrow with the output that its line comes from."""
    graph = parsed(dot)
    names = port_names(graph)
    edges = graph.get_edges()
    lines = [(e.get_source(), e.get_destination()) for e in edges if e.get("dir")]

    def source_of(place: str, passed: frozenset[str] = frozenset()) -> str | None:
        """The output port at the end of the lines without arrows."""
        if ":out_" in place:
            return place
        beside = {a if b == place else b for a, b in lines if place in (a, b)}
        found = (
            source_of(each, passed | {place})
            for each in sorted(beside - passed)
            if ":in_" not in each
        )
        return next(filter(None, found), None)

    def end(text: str | None) -> tuple[str, str]:
        assert text is not None
        block, port, _ = text.rsplit(":", 2)
        return block.strip('"'), names[block.strip('"')][port]

    connections: Counter[Connection] = Counter()
    for edge in edges:
        tail, head = edge.get_source(), edge.get_destination()
        if edge.get("dir") == "none":
            continue
        if edge.get("dir") == "back":
            tail, head = head, tail
        label = edge.get("label")
        size = label.strip('" ') if label else None
        if size is not None and size.endswith(" signals"):
            blocks = [place.rsplit(":", 1)[0].strip('"') for place in (tail, head)]
            ports = [
                {text for port, text in names[block].items() if port.startswith(kind)}
                for block, kind in zip(blocks, ("out_", "in_"), strict=True)
            ]
            same = ports[0] & ports[1]
            assert size == f"{len(same)} signals"
            connections.update((blocks[0], n, blocks[1], n, BUNDLED) for n in same)
            continue
        connections[(*end(source_of(tail)), *end(head), size)] += 1
    return connections


def drake_connections(diagram: Diagram) -> Counter[Connection]:
    return Counter(
        (
            source.get_name(),
            source.get_output_port(output).get_name(),
            sink.get_name(),
            sink.get_input_port(number).get_name(),
            str(source.get_output_port(output).size()),
        )
        for (sink, number), (source, output) in diagram.connection_map().items()
        if not isinstance(sink, LOOKS_ON)
    )


def test_every_connection_is_drawn_once_with_its_size(
    drawn: tuple[Diagram, str],
) -> None:
    diagram, dot = drawn
    found, expected = drawn_connections(dot), drake_connections(diagram)
    bundled = {each[:4] for each in found if each[4] == BUNDLED}
    assert len(bundled) >= 5  # What the monitor hears of the filter.
    assert found == Counter(
        (*each[:4], BUNDLED if each[:4] in bundled else each[4]) for each in expected
    )


def test_every_system_but_the_logs_is_a_block_with_its_class(
    drawn: tuple[Diagram, str],
) -> None:
    diagram, dot = drawn
    graph = parsed(dot)
    systems = [s for s in diagram.GetSystems() if not isinstance(s, LOOKS_ON)]
    assert set(port_names(graph)) == {system.get_name() for system in systems}
    for system in systems:
        label = graph.get_node(f'"{system.get_name()}"')[0].get("label")
        assert re.match(r"[A-Za-z]+", type(system).__name__)[0] in label


def test_every_port_is_named(drawn: tuple[Diagram, str]) -> None:
    diagram, dot = drawn
    for block, ports in port_names(parsed(dot)).items():
        system = diagram.GetSubsystemByName(block)
        inputs, outputs = system.num_input_ports(), system.num_output_ports()
        expected = [system.get_input_port(i).get_name() for i in range(inputs)]
        expected += [system.get_output_port(i).get_name() for i in range(outputs)]
        assert sorted(ports.values()) == sorted(expected)


def test_two_builds_give_the_same_text(blimp_dot: str) -> None:
    again = make_loop(load_scenario("blimp-multiple-obstacles"))
    assert diagram_dot(again) == blimp_dot


def test_committed_files_are_what_another_process_makes(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, DIAGRAMS / "make.py", tmp_path],
        check=True,
        env=os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(DIAGRAMS.parent)},
    )
    made = {path.name: path.read_text() for path in tmp_path.glob("*.dot")}
    committed = {path.name: path.read_text() for path in DIAGRAMS.glob("*.dot")}
    assert set(made) == {f"{name}.dot" for name in COMMITTED}
    assert made == committed, "run python diagrams/make.py"


def test_committed_pictures_are_there_and_small() -> None:
    for name in COMMITTED:
        assert 0 < (DIAGRAMS / f"{name}.svg").stat().st_size < 300_000


def test_the_readme_shows_every_picture() -> None:
    shown = re.findall(r"\]\((.+\.svg)\)", (DIAGRAMS / "README.md").read_text())
    assert sorted(shown) == sorted(path.name for path in DIAGRAMS.glob("*.svg"))


def test_ways_through_the_filter_are_drakes_direct_feedthroughs(
    blimp_loop: Diagram,
) -> None:
    safety_filter = blimp_loop.GetSubsystemByName("filter")
    feeds: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for source, output, sink, port, _ in drawn_connections(filter_dot(safety_filter)):
        start = ("input", output) if source == "inputs" else ("entry", source)
        end = ("output", port) if sink == "outputs" else ("entry", sink)
        feeds.setdefault(end, set()).add(start)

    def reached(end: tuple[str, str]) -> set[tuple[str, str]]:
        before = feeds.get(end, set())
        return before.union(*map(reached, before))

    for i in range(safety_filter.num_output_ports()):
        ways = reached(("output", safety_filter.get_output_port(i).get_name()))
        for j in range(safety_filter.num_input_ports()):
            way = ("input", safety_filter.get_input_port(j).get_name())
            assert (way in ways) == safety_filter.HasDirectFeedthrough(j, i)


def test_the_filters_steps_are_numbered_through(blimp_loop: Diagram) -> None:
    dot = filter_dot(blimp_loop.GetSubsystemByName("filter"))
    numbers = re.findall(r'ALIGN="LEFT">(\d)  ', dot)
    assert numbers == ["1", "2", "3", "4", "5", "6", "7"]


def test_nameless_systems_show_no_addresses() -> None:
    builder = DiagramBuilder()
    adder = builder.AddSystem(Adder(2, 3))
    gains = [builder.AddSystem(Gain(2.0, 3)) for _ in range(2)]
    for i, gain in enumerate(gains):
        builder.Connect(gain.get_output_port(), adder.get_input_port(i))
    LogVectorOutput(adder.get_output_port(), builder)
    builder.AddSystem(Blimp())
    dot = diagram_dot(builder.Build())
    assert set(port_names(parsed(dot))) == {"Adder", "Gain", "Gain 2", "Blimp"}
    assert len(drawn_connections(dot)) == 2
    assert "@" not in dot


def test_a_colon_in_a_name_begins_no_port() -> None:
    builder = DiagramBuilder()
    adder = builder.AddNamedSystem("seen by: north", Adder(1, 2))
    gain = builder.AddNamedSystem("arm::gain", Gain(1.0, 2))
    builder.Connect(adder.get_output_port(), gain.get_input_port())
    dot = diagram_dot(builder.Build())
    (edge,) = parsed(dot).get_edges()
    ends = edge.get_source(), edge.get_destination()
    nodes = {node.get_name() for node in parsed(dot).get_nodes()}
    assert {end.rsplit(":", 2)[0] for end in ends} <= nodes
    assert "<B>seen by: north</B>" in dot and "<B>arm::gain</B>" in dot


def test_a_diagram_with_one_system_is_drawn() -> None:
    builder = DiagramBuilder()
    builder.AddNamedSystem("a <b> & c", Gain(2.0, 1))
    assert "a &lt;b&gt; &amp; c" in diagram_dot(builder.Build())


@pytest.mark.skipif(shutil.which("dot") is None, reason="needs Graphviz' program dot")
def test_graphviz_draws_it_without_complaint(
    blimp_loop: Diagram, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    paths = write_diagram(blimp_loop, tmp_path / "new", "loop")
    assert [path.name for path in paths] == ["loop.dot", "loop.svg"]
    assert all(path.is_file() for path in paths)
    assert capfd.readouterr().err == ""


def test_without_graphviz_one_line_says_what_to_install(
    blimp_loop: Diagram,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    paths = write_diagram(blimp_loop, tmp_path, "loop")
    assert [path.name for path in paths] == ["loop.dot"]
    (message,) = caplog.messages
    assert "apt-get install graphviz" in message and "\n" not in message


def test_graphviz_lays_every_edge_out_to_the_right(blimp_dot: str) -> None:
    """Or the picture is a tangle: no edge closes a circle."""
    after: dict[str, set[str]] = {}
    for edge in parsed(blimp_dot).get_edges():
        tail, head = (
            text.split(":")[0] for text in (edge.get_source(), edge.get_destination())
        )
        after.setdefault(tail, set()).add(head)

    def reached(place: str, way: tuple[str, ...]) -> None:
        assert place not in way, f"{' '.join((*way, place))}"
        for each in after.get(place, ()):
            reached(each, (*way, place))

    for place in list(after):
        reached(place, ())


def test_loops_of_any_shape_are_drawn() -> None:
    builder = DiagramBuilder()
    gains = [builder.AddNamedSystem(f"gain {k}", Gain(2.0, 1)) for k in range(3)]
    rest = builder.AddNamedSystem("integrator", Integrator(1))
    for before, after in pairwise([rest, *gains, rest]):
        builder.Connect(before.get_output_port(), after.get_input_port())
    diagram = builder.Build()
    assert drawn_connections(diagram_dot(diagram)) == drake_connections(diagram)
