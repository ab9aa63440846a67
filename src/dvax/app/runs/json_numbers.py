"""Numbers that are not finite in JSON files, which has no spelling for them.

Every JSON file of a run spells them as the strings "inf", "-inf" and "nan": `float` of Python and
NumPy reads these back. Terminal and page show ∞, −∞ and NaN (`dvax._figure_text`).
"""

import math
from collections.abc import Mapping
from typing import Any

SAYS_NOTHING = "; it is not finite, so it says nothing"


def json_ready(content: Any) -> Any:
    """The same content with every number that is not finite as a string."""
    if isinstance(content, Mapping):
        return {key: json_ready(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [json_ready(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return str(float(content))
    return content


def bound_meaning(meaning: str, value: Any) -> str:
    """The meaning of a bound; it says so where the bound is infinite or NaN."""
    values = value if isinstance(value, list) else [value]
    finite = all(math.isfinite(v) for v in values if isinstance(v, float))
    return meaning if finite else meaning + SAYS_NOTHING
