"""A hook of mkdocs: pages must load nothing from elsewhere."""

import re
from typing import Any

from mkdocs.exceptions import PluginError

ELSEWHERE = re.compile(r"""<(?:script|link|img|source|iframe)\b[^>]*\b(?:src|href)=["']?(?:https?:)?//[^"'>\s]*""")


def on_post_page(output: str, *, page: Any, **_: Any) -> str:
    """The page as it is. Raises PluginError for what it would load from another server."""
    found = ELSEWHERE.search(output)
    if found is not None:
        raise PluginError(f"{page.file.src_uri} would load from elsewhere: {found[0]}")
    return output
