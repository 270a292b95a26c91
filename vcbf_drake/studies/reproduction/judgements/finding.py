"""What a judgement returns, and what it reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

Data = Mapping[str, Any]


class Finding(NamedTuple):
    """What the results say of a claim.

    Attributes:
        holds: Whether the claim holds in the main setting; None when there are too few
            trials to tell.
        everywhere: Whether it also holds in the settings that stand beside it.
        number: The numbers that say so.
    """

    holds: bool | None
    everywhere: bool
    number: str
