"""Bodies without a mass, by which newer Drake divides even where it is symbolic."""

from __future__ import annotations

from typing import Any

from pydrake.multibody.tree import BodyIndex
from pydrake.symbolic import Expression

# Next to nothing: a billionth of a milligram [kg].
_MASS = 1e-15


def give_mass(system: Any, context: Any) -> bool:
    """Gives massless bodies of a symbolic MultibodyPlant next to no mass.

    A body that only carries a frame, such as a tool's tip or a stand, often has none.

    Args:
        system: Any symbolic System; of a Diagram, the plants inside.
        context: Its context, which is changed.

    Returns:
        Whether there was such a body.
    """
    if hasattr(system, "GetSystems"):
        inside = [
            give_mass(each, each.GetMyMutableContextFromRoot(context))
            for each in system.GetSystems()
        ]
        return any(inside)
    if not hasattr(system, "num_bodies"):
        return False
    bodies = [system.get_body(BodyIndex(i)) for i in range(1, system.num_bodies())]
    massless = [body for body in bodies if body.default_mass() == 0.0]
    for body in massless:
        body.SetMass(context, Expression(_MASS))
    return bool(massless)
