"""Ways in which files are wrong: each changes a file by a rule that knows nothing of what the file is for."""

import codecs
import json
import math
import random
import shutil
from pathlib import Path
from typing import Any

VALUES: dict[str, Any] = {
    "null": None, "text": "a", "empty": "", "list": [], "object": {}, "yes": True, "nan": math.nan,
    "infinite": math.inf, "negative": -1, "zero": 0, "huge": 1e308, "tiny": 1e-308, "a long number": 10**400,
    "a long text": "a" * 10**6,
}  # fmt: skip
"""What may stand in a JSON file in the place of another value."""
WRITTEN = {"given twice": '{old}, "{name}": {old}', "nested": "[" * 100_000 + "]" * 100_000}
"""What may stand there that is not the JSON of any value."""
OF_ANY = (*VALUES, "nested")
OF_MEMBERS = ("missing", "given twice")
OF_LISTS = ("one too long", "one too short")
OF_FILES = (
    *(f"{way} {share}" for way in ("cut at", "noise from") for share in (0.0, 0.02, 0.5, 0.9)),
    "missing", "a folder", "a loop of links", "zeros", "a photograph", "behind a mark", "of Windows",
)  # fmt: skip
"""What may be wrong with a file of any kind."""
PLACE = "the place"


def spoil_field(path: Path, field: str, kind: str) -> None:
    """Make a field of a JSON file wrong: the names and numbers on the way to it are parted by slashes."""
    content = json.loads(path.read_text())
    *way, last = [int(part) if part.isdigit() else part for part in field.split("/")]
    holder = content
    for part in way:
        holder = holder[part]
    old = holder[last]
    if kind == "missing":
        del holder[last]
    elif kind == "one too long":
        holder[last] = [*old, old[0]]
    elif kind == "one too short":
        holder[last] = old[1:]
    else:
        holder[last] = VALUES.get(kind, PLACE)
    written = WRITTEN.get(kind, "").replace("{old}", json.dumps(old)).replace("{name}", str(last))
    path.write_text(json.dumps(content).replace(f'"{PLACE}"', written))


def spoil_file(path: Path, kind: str) -> None:
    """Make a file wrong."""
    *way, share = kind.split()
    content = path.read_bytes()
    path.unlink()
    if way in (["cut", "at"], ["noise", "from"]):
        whole = content[: int(float(share) * len(content))]
        rest = b"" if way[0] == "cut" else random.Random(1).randbytes(len(content) - len(whole))
        path.write_bytes(whole + rest)
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a loop of links":
        path.symlink_to(path.name)
    elif kind == "zeros":
        path.write_bytes(bytes(len(content)))
    elif kind == "behind a mark":
        path.write_bytes(codecs.BOM_UTF8 + content)
    elif kind == "of Windows":
        path.write_bytes(content.replace(b"\n", b"\r\n"))
    elif kind == "a photograph":
        shutil.copy(next(path.parents[1].rglob("*.jpg")), path)
