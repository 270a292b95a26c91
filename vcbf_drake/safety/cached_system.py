"""CachedSystem: a Drake system whose outputs are read from cache entries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    CacheEntry,
    Context,
    DependencyTicket,
    LeafSystem,
    OutputPort,
    ValueProducer,
)


class CachedSystem(LeafSystem):
    """Calculates every Python object once for a context, however many ports read it."""

    def _entry(
        self,
        name: str,
        calc: Callable[[Context], object],
        needs: set[DependencyTicket],
    ) -> CacheEntry:
        """Declares a cache entry for the result of `calc`.

        Args:
            name: For Drake's messages.
            calc: Calculates it.
            needs: Its prerequisites.
        """
        producer = ValueProducer(
            allocate=lambda: Value[object](),
            # In a tuple, for newer pydrake takes no None.
            calc=lambda context, value: value.set_value((calc(context),)),
        )
        return self.DeclareCacheEntry(name, producer, needs)

    def _output(
        self, name: str, size: int, entry: CacheEntry, read: Callable[[Any], object]
    ) -> OutputPort:
        """Declares a vector port that reads an entry.

        Args:
            name: The port's.
            size: The port's.
            entry: The entry.
            read: Returns the port's value from the entry's.
        """

        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(read(held_by(entry, context)))

        return self.DeclareVectorOutputPort(name, size, calc, {entry.ticket()})


def held_by(entry: CacheEntry, context: Context) -> Any:
    """Returns the value of an entry."""
    (found,) = entry.Eval(context)
    return found
