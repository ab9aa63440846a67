"""What the scripts of a page draw, read from its text."""

import base64
import gzip
import json
import re
from typing import Any


def figures_of(page: str) -> dict[str, Any]:
    """Return the figures of a page by their keys."""
    found = re.search(r'<script type="text/plain" id="data">([^<]*)</script>', page)
    assert found is not None, "the page has no figures"
    content: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(found[1])))
    return content["figures"]
