"""Pages from templates: what is inserted is escaped, and style and pictures are part of the page.

Pictures are data URIs: nothing is fetched when the page is opened.
"""

import base64
import io
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from torchrefrac import __version__
from torchrefrac.atomic import replacing
from torchrefrac.files.photographs import read_color
from torchrefrac.scene import CaptureError

SHADES = 256
DOTS_PER_INCH, FILE_DOTS_PER_INCH = 140, 150
PIXELS_PER_INCH, WIDEST = 96, 1040  # of the page
THUMBNAIL_PIXELS, THUMBNAIL_QUALITY = 160, 72


class Picture(NamedTuple):
    """A data URI, and how wide it is in the page, in the page's pixels."""

    source: str
    width: int


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


def svg(figure: Any) -> Picture:
    """A figure of few lines, sharp at any size; the same figure always gives the same text."""
    from matplotlib import rc_context  # noqa: PLC0415 - slow to import

    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "torchrefrac"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    width = round(PIXELS_PER_INCH * figure.get_size_inches()[0])
    return Picture(_uri("svg+xml", buffer.getvalue()), width)


def png(figure: Any) -> Picture:
    """A figure of many points, cut to what is drawn: panels of equal scales may leave room, or need a little more."""
    from PIL import Image  # noqa: PLC0415 - comes with matplotlib

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", pad_inches=0.06)
    with Image.open(buffer) as image:
        width = round(image.width * PIXELS_PER_INCH / DOTS_PER_INCH)
    return Picture(_uri("png", buffer.getvalue()), width)


def picture(path: Path, width: int) -> Picture:
    """A drawn picture in a file, scaled down to `width` pixels. Raises OSError where it cannot be read."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(path) as image:
        height = max(1, round(image.height * width / image.width))
        scaled = image.convert("RGB")
        small = scaled.resize((width, height), Image.Resampling.LANCZOS) if image.width > width else scaled
        shown = min(WIDEST, round(image.width * PIXELS_PER_INCH / FILE_DOTS_PER_INCH))
    buffer = io.BytesIO()
    small.quantize(SHADES, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    return Picture(_uri("png", buffer.getvalue()), shown)


def thumbnail(path: Path) -> str:
    """A photograph as a small JPEG; empty where it cannot be read."""
    if not path.is_file():
        return ""
    try:
        image = read_color(path)
    except CaptureError:
        return ""
    height, width = image.shape[:2]
    scale = min(1.0, THUMBNAIL_PIXELS / max(height, width))
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    done, coded = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY))
    return _uri("jpeg", coded.tobytes()) if done else ""


def _read(name: str) -> str:
    return files(__package__ or "").joinpath(name).read_text(encoding="utf-8")


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
