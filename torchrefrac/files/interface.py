"""What capture.json and truth.json say of the surface that light is bent at."""

from torchrefrac.files.fields import Fields
from torchrefrac.scene.interfaces import INDEX_RATIO_RANGE, MAX_INDEX_RATIO

SURFACE, LATER = "surface", ("wall", "port")


def read_index_ratio(top: Fields) -> float:
    """n_water / n_air of the surface that `top` states: by `interface`, or by `index_ratio` for short."""
    if "interface" not in top:
        return _index_ratio(top)
    if "index_ratio" in top:
        raise top.fail("index_ratio", "is given beside interface; leave it out, or state it there")
    interface = top.object("interface")
    interface.only("kind", "index_ratio", "layers")
    if "kind" in interface and interface.must_be("kind", SURFACE, *LATER) in LATER:
        raise interface.fail(
            "kind", f"is {interface.text('kind')!r}, which cannot be reconstructed yet; {SURFACE!r} can"
        )
    if "layers" not in interface:
        return _index_ratio(interface)
    layers = interface.objects("layers")
    if len(layers) != 2:
        raise interface.fail("layers", f"lists {len(layers)}, but a surface has two: air and water")
    for layer in layers:
        layer.only("index")
    above, below = (layer.positive("index", MAX_INDEX_RATIO) for layer in layers)
    return _within(interface, "layers", below / above)


def _index_ratio(fields: Fields) -> float:
    return _within(fields, "index_ratio", fields.number("index_ratio"))


def _within(fields: Fields, name: str, ratio: float) -> float:
    if not 1.0 <= ratio <= MAX_INDEX_RATIO:
        raise fields.fail(name, f"is {ratio:g}, but {INDEX_RATIO_RANGE}")
    return ratio
