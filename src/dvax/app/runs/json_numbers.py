"""Non-finite numbers in JSON files, which JSON cannot represent.

Every JSON file of a run writes them as the strings "inf", "-inf" and "nan": `float` of Python and
NumPy reads these back. Terminal and page show ∞, −∞ and NaN (`dvax._figure_text`).
"""

import math
from collections.abc import Mapping
from typing import Any


def json_ready(content: Any) -> Any:
    """Return the content with every non-finite number as a string."""
    if isinstance(content, Mapping):
        return {key: json_ready(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [json_ready(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return str(float(content))
    return content
