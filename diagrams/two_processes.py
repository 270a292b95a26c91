"""The two processes of a loop over LCM, with the channels between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import VectorLogSink

from vcbf_drake.viz.block_graph import Block, Wire, graph_dot

if TYPE_CHECKING:
    from vcbf_drake.hil import Bus, InProcess


def hardware_dot(run: InProcess, title: str) -> str:
    """Returns the picture as DOT: what each process holds, sends and hears.

    Both are run for a second, in which everything is sent once.

    Raises:
        ValueError: The controller is dead.
    """
    controller, vehicle = run.controller, run.plant
    if controller is None:
        raise ValueError("controller: None; the picture needs both processes")
    passing = {each: _passing_channels(each.bus) for each in (controller, vehicle)}
    run.advance_to(1.0)
    blocks = tuple(
        Block(
            name,
            command,
            tuple(process.bus.subscribed),
            tuple(c for c in passing[process] if c not in process.bus.subscribed),
            _systems(process.diagram),
        )
        for name, command, process in (
            ("controller process", "vcbf-drake controller", controller),
            ("vehicle process", "vcbf-drake plant", vehicle),
        )
    )
    wires = [
        Wire(source.name, i, sink.name, j, 0)
        for source, sink in (blocks, blocks[::-1])
        for i, channel in enumerate(source.outputs)
        for j, heard in enumerate(sink.inputs)
        if heard == channel
    ]
    return graph_dot(blocks, wires, title)


def _passing_channels(bus: Bus) -> dict[str, None]:
    """Returns the channels of what is sent or arrives from now on."""
    channels: dict[str, None] = {}
    bus.taps.append(lambda utime, channel, data: channels.setdefault(channel))
    return channels


def _systems(diagram: Diagram) -> tuple[str, ...]:
    systems = diagram.GetSystems()
    return tuple(s.get_name() for s in systems if not isinstance(s, VectorLogSink))
