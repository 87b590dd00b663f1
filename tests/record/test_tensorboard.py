"""What TensorBoard is given can be read back."""

import errno

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.mesh import metadata as mesh_metadata
from tensorboard.util.tensor_util import make_ndarray

from torchrefrac.record import tensorboard
from torchrefrac.record.tensorboard import MOST_POINTS, TensorBoardRecorder, remove_events

EVERYTHING = {"scalars": 0, "images": 0, "histograms": 0, "tensors": 0}


def read(folder):
    events = EventAccumulator(str(folder), size_guidance=EVERYTHING)
    events.Reload()
    return events


@pytest.fixture
def recorded(tmp_path):
    """`recorded(tell)`: the events after `tell(board)`."""

    def record(tell):
        with TensorBoardRecorder(tmp_path / "events") as board:
            tell(board)
        return read(tmp_path / "events")

    return record


def test_curves_keep_their_steps(recorded):
    events = recorded(lambda board: [board.scalar("adjustment/cost", 10.0 / step, step) for step in (1, 2, 5)])

    assert [(event.step, event.value) for event in events.Scalars("adjustment/cost")] == [(1, 10.0), (2, 5.0), (5, 2.0)]


def test_a_histogram_counts_the_values_that_are_finite(recorded):
    values = torch.tensor([0.5, 1.0, torch.inf, 2.0, torch.nan])

    events = recorded(lambda board: board.histogram("residuals/px", values, 3))

    (event,) = events.Histograms("residuals/px")
    told = event.histogram_value
    assert (event.step, told.num, told.min, told.max, told.sum) == (3, 3, 0.5, 2.0, 3.5)


def test_values_none_of_which_is_finite_make_no_histogram(recorded):
    events = recorded(lambda board: board.histogram("residuals/px", torch.tensor([torch.inf]), 0))

    assert events.Tags()["histograms"] == []


def test_a_picture_comes_back_in_its_colours(recorded):
    picture = torch.zeros(40, 60, 3, dtype=torch.uint8)
    picture[:, :30, 0], picture[:, 30:, 2] = 200, 250

    events = recorded(lambda board: board.picture("matches/1", picture, 0))

    (event,) = events.Images("matches/1")
    back = cv2.imdecode(np.frombuffer(event.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert (event.width, event.height) == (60, 40)
    assert back[20, 10].tolist() == pytest.approx([200, 0, 0], abs=4)
    assert back[20, 50].tolist() == pytest.approx([0, 0, 250], abs=4)


def test_a_cloud_is_a_mesh_with_colours(recorded, draw):
    points, colors = draw.normal(7, 3), torch.arange(21, dtype=torch.uint8).reshape(7, 3)

    events = recorded(lambda board: board.cloud("sparse", points, colors, 2))

    assert set(events.PluginTagToContent(mesh_metadata.PLUGIN_NAME)) == {"sparse_VERTEX", "sparse_COLOR"}
    (vertices,), (painted,) = events.Tensors("sparse_VERTEX"), events.Tensors("sparse_COLOR")
    assert vertices.step == 2
    assert make_ndarray(vertices.tensor_proto)[0] == pytest.approx(points.float().numpy())
    assert [dim.size for dim in painted.tensor_proto.tensor_shape.dim] == [1, 7, 3]


def test_a_cloud_of_a_map_is_shown_around_its_middle(recorded, draw):
    points = draw.normal(7, 3)
    colors, origin = torch.zeros(7, 3, dtype=torch.uint8), torch.tensor([512345.0, 4123456.0, 100.0]).double()

    events = recorded(lambda board: board.cloud("sparse", points + origin, colors, 0))

    (vertices,) = events.Tensors("sparse_VERTEX")
    shown = points - points.median(dim=0).values
    assert make_ndarray(vertices.tensor_proto)[0] == pytest.approx(shown.numpy(), abs=1e-6)


def test_of_a_large_cloud_so_many_points_are_kept_that_the_events_stay_small(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(tensorboard, "MOST_POINTS", 1000)
    points, colors = torch.rand(2001, 3, dtype=torch.float64), torch.zeros(2001, 3, dtype=torch.uint8)

    events = recorded(lambda board: board.cloud("dense", points, colors, 0))

    (vertices,) = events.Tensors("dense_VERTEX")
    assert [dim.size for dim in vertices.tensor_proto.tensor_shape.dim] == [1, 667, 3]
    size = sum(path.stat().st_size for path in (tmp_path / "events").iterdir())
    assert size / 667 * MOST_POINTS < 20e6


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((1, 3), 5.0)])
def test_clouds_of_no_extent_do_no_harm(recorded, points):
    events = recorded(lambda board: board.cloud("sparse", points, points.byte(), 0))

    assert len(events.Tags()["tensors"]) == (2 if len(points) else 0)


def test_a_run_is_one_line_of_the_table_of_runs(recorded, tmp_path):
    options = {"model": "none", "water.index_ratio": 1.2, "seed": 3, "outputs.mesh": True, "water.temperature_c": None}
    metrics = {"seconds_total": 9.0, "status": "complete", "points": 40, "camera_rms_cm": 0.25, "x": float("nan")}

    events = recorded(lambda board: board.hparams(options, metrics))

    content = events.PluginTagToContent(metadata.PLUGIN_NAME)
    assert set(content) == {metadata.EXPERIMENT_TAG, metadata.SESSION_START_INFO_TAG, metadata.SESSION_END_INFO_TAG}
    start = metadata.parse_session_start_info_plugin_data(content[metadata.SESSION_START_INFO_TAG])
    told = {name: getattr(value, value.WhichOneof("kind")) for name, value in start.hparams.items()}
    assert told == {"model": "none", "water.index_ratio": 1.2, "seed": 3, "outputs.mesh": True}
    assert events.Scalars("metrics/camera_rms_cm")[0].value == 0.25
    experiment = metadata.parse_experiment_plugin_data(content[metadata.EXPERIMENT_TAG])
    assert [info.name.tag for info in experiment.metric_infos] == [
        "metrics/camera_rms_cm", "metrics/points", "metrics/seconds_total",
    ]  # fmt: skip
    assert len(list((tmp_path / "events").iterdir())) == 1


def test_a_run_that_failed_does_not_decide_the_columns_of_the_table(recorded):
    events = recorded(lambda board: board.hparams({"model": "none"}, {"status": "failed"}))

    content = events.PluginTagToContent(metadata.PLUGIN_NAME)
    assert set(content) == {metadata.SESSION_START_INFO_TAG, metadata.SESSION_END_INFO_TAG}


def test_what_a_stage_has_told_can_be_read_when_it_ends(tmp_path):
    with TensorBoardRecorder(tmp_path) as board:
        for i in board.track(range(2), 2, "matching", "pair"):
            board.scalar("tracked", i, i)
        tracked = read(tmp_path)
        with board.meter(2, "densifying", "cell") as advance:
            advance(2, "")
            board.scalar("metered", 1.0, 0)
        metered = read(tmp_path)

    assert len(tracked.Scalars("tracked")) == 2
    assert len(metered.Scalars("metered")) == 1


def test_a_run_that_breaks_off_leaves_its_events(tmp_path):
    def run():
        with TensorBoardRecorder(tmp_path) as board:
            board.scalar("a", 1.0, 0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()

    assert len(read(tmp_path).Scalars("a")) == 1


def test_events_that_cannot_be_written_do_not_hide_why_a_run_failed(tmp_path, monkeypatch):
    from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - slow to import

    close = SummaryWriter.close

    def full(writer):
        close(writer)
        raise OSError(errno.ENOSPC, "No space left on device")

    def run():
        with TensorBoardRecorder(tmp_path):
            monkeypatch.setattr(SummaryWriter, "close", full)
            raise RuntimeError("no two images can be related")

    with pytest.raises(RuntimeError, match="no two images can be related"):
        run()


def test_events_of_an_earlier_run_are_removed_and_nothing_else(tmp_path):
    with TensorBoardRecorder(tmp_path) as board:
        board.scalar("a", 1.0, 0)
    (tmp_path / "mine.txt").write_text("")

    remove_events(tmp_path)

    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_disk_that_is_full_is_one_error_where_the_recorder_is_called(tmp_path, monkeypatch, capfd):
    from tensorboard.summary.writer.record_writer import RecordWriter  # noqa: PLC0415 - slow to import

    def full(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"), TensorBoardRecorder(tmp_path) as board:  # noqa: PT012
        monkeypatch.setattr(RecordWriter, "write", full)
        for step in range(100):
            board.scalar("cost", 1.0, step)
        board.hparams({}, {})

    assert "Traceback" not in capfd.readouterr().err
