"""The packet of XMP in a photograph, as texts by their names."""

import io
from collections.abc import Iterator, Mapping
from xml.etree import ElementTree

MOST_BYTES = 1 << 22
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
LISTS = (f"{RDF}Seq", f"{RDF}Bag", f"{RDF}Alt")
MOST_NESTED = 2  # structures in one another
DECLARATIONS = (b"<!DOCTYPE", b"<!ENTITY")


class Xmp:
    """Texts by the names that their maker gave them ("drone-dji:GimbalYawDegree"), those of structures with the names
    of both ("drone-skydio:CameraOrientationNED/Yaw"), lists separated by commas.

    problem: why a packet that is there could not be read. Packets with a document type are refused: entities could make
    them as large as the memory.
    """

    def __init__(self, packet: bytes) -> None:
        self.problem = ""
        self._texts: Mapping[str, str] = {}
        start, end = packet.find(b"<"), packet.rfind(b">")
        if end <= start:
            return
        if len(packet) > MOST_BYTES or any(word in packet for word in DECLARATIONS):
            self.problem = "its XMP is longer or other than any camera writes"
            return
        try:
            self._texts = dict(_texts(packet[start : end + 1]))
        except ElementTree.ParseError:
            self.problem = "its XMP is damaged"

    def __bool__(self) -> bool:
        return bool(self._texts)

    def text(self, *names: str) -> str:
        """Of the first of these that is there; else empty."""
        return next((self._texts[name] for name in names if self._texts.get(name)), "")

    def number(self, *names: str) -> float | None:
        """Of the first of these that is there, as 12.5, +12.5 or 25/2."""
        return as_number(self.text(*names))


def as_number(text: str) -> float | None:
    """None for what is no number, or not finite."""
    above, _, below = text.partition("/")
    try:
        number = float(above) / float(below or 1.0)
    except (ValueError, ZeroDivisionError):
        return None
    return number if abs(number) < float("inf") else None


def _texts(packet: bytes) -> Iterator[tuple[str, str]]:
    """Every property and its text."""
    prefixes: dict[str, str] = {}
    root = None
    for event, item in ElementTree.iterparse(io.BytesIO(packet), events=("start-ns", "start")):
        if event == "start-ns":
            prefix, address = item
            prefixes.setdefault(address, prefix)
        elif root is None:
            root = item
    for description in () if root is None else root.iter(f"{RDF}Description"):
        yield from _properties(description, prefixes, "")


def _properties(element: ElementTree.Element, prefixes: Mapping[str, str], path: str) -> Iterator[tuple[str, str]]:
    """Attributes, elements, lists, and what lies in structures."""
    for name, value in element.attrib.items():
        if not name.startswith(RDF):
            yield path + _name(name, prefixes, path), value.strip()
    for child in element:
        name = path + _name(child.tag, prefixes, path)
        items = [item for kind in LISTS for item in child.findall(f"{kind}/{RDF}li")]
        yield name, ",".join((item.text or "").strip() for item in (items or [child]))
        if path.count("/") < MOST_NESTED:
            for structure in (child, *child.findall(f"{RDF}Description")):
                yield from _properties(structure, prefixes, f"{name}/")


def _name(tag: str, prefixes: Mapping[str, str], path: str) -> str:
    """With the prefix of its namespace, but inside a structure, which has the same."""
    address, _, local = tag.removeprefix("{").rpartition("}")
    return local if path else f"{prefixes.get(address, '')}:{local}"
