"""Clouds of points of other programs: read, changed point by point and written again in parts, with all that they
hold."""

from torchrefrac.files.clouds.cloud import Changed, Cloud, CloudError
from torchrefrac.files.clouds.formats import ENDINGS, open_cloud

__all__ = ["ENDINGS", "Changed", "Cloud", "CloudError", "open_cloud"]
