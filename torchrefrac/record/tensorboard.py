"""Curves, histograms, pictures, clouds and the table of runs for TensorBoard."""

import threading
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import cv2
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from torchrefrac.files.ply import kind_of_coordinates
from torchrefrac.files.run import is_number
from torchrefrac.recorder import Advance, SilentRecorder

T = TypeVar("T")
FLUSH_SECONDS = 5
MOST_POINTS = 100_000  # of a cloud: 2.4 MB
QUALITY = 85  # of pictures, as JPEG
POINTS_ACROSS = 300  # size of a point, as a part of the cloud's extent
COLUMNS = (
    "camera_rms", "point_rms", "surface_median", "flatness", "dense_surface", "reprojection_median", "registered",
)  # fmt: skip
"""How the names of the metrics begin that come first in the table of runs, which shows few unless asked for more."""
LAST = "seconds"


class TensorBoardRecorder(SilentRecorder):
    """Writes events into `folder`, flushed every few seconds and after every stage so that a running job can be
    watched; closes on exit, without hiding the error that ends a run."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - slow to import

        self._writer = SummaryWriter(str(folder), flush_secs=FLUSH_SECONDS)
        self._hook = threading.excepthook

    def __enter__(self) -> "TensorBoardRecorder":
        self._hook, threading.excepthook = threading.excepthook, self._report_thread
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
        except OSError:
            if error is None:
                raise
        finally:
            threading.excepthook = self._hook

    def _report_thread(self, failure: threading.ExceptHookArgs) -> None:
        """Errors of threads but those of a full disk in TensorBoard's own: it raises them again where it is called."""
        is_known = isinstance(failure.exc_value, OSError) and type(failure.thread).__module__.startswith("tensorboard.")
        if not is_known:
            self._hook(failure)

    @property
    def wants_pictures(self) -> bool:
        return True

    def scalar(self, name: str, value: float, step: int) -> None:
        self._writer.add_scalar(name, value, step)

    def histogram(self, name: str, values: Shaped[Tensor, " n"], step: int) -> None:
        finite = values[values.isfinite()]
        if len(finite):
            self._writer.add_histogram(name, finite, step)

    def picture(self, name: str, image: UInt8[Tensor, "height width 3"], step: int) -> None:
        from tensorboard.compat.proto import summary_pb2  # noqa: PLC0415 - slow to import

        height, width, channels = image.shape
        _, encoded = cv2.imencode(".jpg", image.numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        proto: Any = summary_pb2  # its classes are made when it is loaded
        shown = proto.Summary.Image(
            height=height, width=width, colorspace=channels, encoded_image_string=encoded.tobytes()
        )
        written = proto.Summary(value=[proto.Summary.Value(tag=name, image=shown)])
        self._writer._get_file_writer().add_summary(written, step)  # pyright: ignore[reportPrivateUsage]

    def cloud(self, name: str, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], step: int) -> None:
        """Of a large cloud every n-th point alone; what is too far from the origin for float32, around its middle."""
        every = -(-len(points) // MOST_POINTS)
        if not every:
            return
        points, colors = points[::every], colors[::every]
        if kind_of_coordinates(points) == "f8":
            points = points - points.median(dim=0).values
        size = float((points.amax(dim=0) - points.amin(dim=0)).max()) / POINTS_ACROSS
        look = {"material": {"cls": "PointsMaterial", "size": size}}
        self._writer.add_mesh(name, points[None].float(), colors[None].int(), config_dict=look, global_step=step)

    def hparams(self, options: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        """Enter the run into the table of runs: `options` by dotted names, and the finite numbers among `metrics`.

        Values of options that are neither text, number nor bool are left out. A run without metrics has a line too.
        """
        from torch.utils.tensorboard.summary import hparams  # noqa: PLC0415 - slow to import

        chosen = {name: value for name, value in options.items() if isinstance(value, str | int | float | bool)}
        numbers = {name: float(value) for name, value in metrics.items() if is_number(value)}
        reached = {f"metrics/{name}": numbers[name] for name in sorted(numbers, key=_column)}
        experiment, start, end = hparams(chosen, reached)
        writer = self._writer._get_file_writer()  # pyright: ignore[reportPrivateUsage]
        # TensorBoard takes the columns of the table from the first experiment that it finds.
        for summary in (experiment, start, end) if reached else (start, end):
            writer.add_summary(summary)
        for name, value in reached.items():
            self._writer.add_scalar(name, value, 0)
        self._writer.flush()

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        yield from items
        self._writer.flush()

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Generator[Advance, None, None]:
        yield lambda count, text: None
        self._writer.flush()


def remove_events(folder: Path) -> None:
    """Remove the events that an earlier run has left in a folder."""
    for path in folder.glob("events.out.tfevents.*"):
        path.unlink()


def _column(name: str) -> int:
    first = next((i for i, start in enumerate(COLUMNS) if name.startswith(start)), len(COLUMNS))
    return len(COLUMNS) + 1 if name.startswith(LAST) else first
