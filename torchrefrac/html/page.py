"""Pages from templates: what is inserted is escaped, and the style is part of the page."""

from importlib.resources import files
from pathlib import Path
from typing import Any

from torchrefrac import __version__
from torchrefrac.atomic import replacing


def write_page(template: str, path: Path, **content: Any) -> None:
    """Fill in a template of this package and write the page."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined  # noqa: PLC0415 - only reports need it
    from markupsafe import Markup  # noqa: PLC0415

    environment = Environment(
        loader=FunctionLoader(_read), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    page = environment.get_template(template).render(style=Markup(_read("style.css")), version=__version__, **content)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _read(name: str) -> str:
    return files(__package__ or "").joinpath(name).read_text(encoding="utf-8")
