"""The format of a cloud by the ending of its name."""

from collections.abc import Callable
from pathlib import Path

from torchrefrac.files.clouds.cloud import Cloud, CloudError
from torchrefrac.files.clouds.las import LasCloud
from torchrefrac.files.clouds.ply import PlyCloud
from torchrefrac.files.clouds.table import TableCloud

READERS: dict[str, Callable[[Path], Cloud]] = {
    ".las": LasCloud.open, ".laz": LasCloud.open, ".ply": PlyCloud.open, ".csv": TableCloud.open,
}  # fmt: skip
ENDINGS = tuple(READERS)


def open_cloud(path: Path) -> Cloud:
    """A cloud whose points are read later. Raises CloudError where it is missing, damaged, of another format or has no
    points."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise CloudError(f"cloud is {path}, but its name must end in {', '.join(ENDINGS)}")
    if not path.is_file():
        raise CloudError(f"{path} is not a file, but cloud must be one")
    cloud = reader(path)
    if not cloud.count:
        raise CloudError(f"{path} has no points; there is nothing to correct")
    return cloud
