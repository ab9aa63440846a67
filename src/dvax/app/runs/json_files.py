"""JSON files of a run: non-finite numbers, which JSON cannot represent, and files that may be damaged.

Every JSON file of a run writes them as the strings "inf", "-inf" and "nan": `float` of Python and
NumPy reads these back. Terminal and page show ∞, −∞ and NaN (`dvax._figure_text`).
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
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


def read_object(file: Path) -> dict[str, Any]:
    """Return the object of a JSON file; an empty one where the file is missing or damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
