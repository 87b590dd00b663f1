"""The scenes that can be made, by kind."""

from torchrefrac.scene.synthetic.options import SyntheticOptions

SCENES: dict[str, type[SyntheticOptions]] = {}
