"""The data of a replay page."""

import json
import re
from typing import Any


def page_data(page: str) -> dict[str, Any]:
    """What a page's scripts show; no number of it is without a value in JSON."""
    found = re.search(r'id="replay-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None

    def refuse(constant: str) -> None:
        raise AssertionError(f"the page's data holds {constant}")

    data: dict[str, Any] = json.loads(found[1], parse_constant=refuse)
    return data
