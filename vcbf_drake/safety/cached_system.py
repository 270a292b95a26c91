"""CachedSystem: a Drake system whose outputs are read from cache entries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    CacheEntry,
    Context,
    DependencyTicket,
    LeafSystem,
    ValueProducer,
)

_T = TypeVar("_T")


class Cached(Generic[_T]):
    """A function of a system's context, evaluated once however many ports read it."""

    def __init__(self, entry: CacheEntry) -> None:
        self._entry = entry
        self.ticket: DependencyTicket = entry.ticket()

    def __call__(self, context: Context) -> _T:
        """Returns the value, calculated if the context's is out of date."""
        (found,) = self._entry.Eval(context)
        value: _T = found
        return value


class CachedSystem(LeafSystem):
    """Calculates every Python object once for a context."""

    def _cached(
        self,
        name: str,
        calc: Callable[[Context], _T],
        needs: set[DependencyTicket],
    ) -> Cached[_T]:
        """Declares a cache entry for what `calc` returns, with its prerequisites."""
        producer = ValueProducer(
            allocate=lambda: Value[object](),
            # In a tuple, for newer pydrake takes no None.
            calc=lambda context, value: value.set_value((calc(context),)),
        )
        return Cached(self.DeclareCacheEntry(name, producer, needs))

    def _output(
        self, name: str, size: int, source: Cached[_T], read: Callable[[_T], object]
    ) -> None:
        """Declares a vector port: what `read` returns of a cached value."""

        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(read(source(context)))

        self.DeclareVectorOutputPort(name, size, calc, {source.ticket})
