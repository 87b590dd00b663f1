"""Docstrings are plain text: their asterisks are of shapes (*B), not of Markdown. An extension of griffe."""

import re

from griffe import Extension, Object

_CODE = re.compile(r"(`[^`]*`|^ {4}.*$)", flags=re.MULTILINE)


class PlainDocstrings(Extension):
    """Escapes, outside of code, what Markdown would take for emphasis."""

    def on_object(self, *, obj: Object, **_: object) -> None:
        """Change the docstring of whatever was read."""
        if obj.docstring is not None:
            parts = _CODE.split(obj.docstring.value)
            parts[::2] = [part.replace("*", r"\*") for part in parts[::2]]
            obj.docstring.value = "".join(parts)
