"""`torchrefrac import` of a film: which frames are taken, and what is left of it."""

import csv
import json
import shutil

import cv2
import numpy as np
import pytest

from torchrefrac import load_capture
from torchrefrac.files.metadata.film import Look, choose

SIZE, FRAMES, STEP = (320, 240), 60, 4  # px; a camera that moves by so many pixels a frame


@pytest.fixture(scope="module")
def film(made_once):
    """A flight over textured ground, every sixth frame sharp and the others not; as a film of 30 frames a second."""

    def make(folder):
        random = np.random.default_rng(3)
        ground = np.zeros((SIZE[1], SIZE[0] + FRAMES * STEP, 3))
        for size in (0.7, 1.0, 2.0, 4.0, 8.0):
            ground += 30.0 * size * cv2.GaussianBlur(random.normal(size=ground.shape), (0, 0), size)
        ground = (128 + ground).clip(0, 255).astype(np.uint8)
        writer = cv2.VideoWriter(str(folder / "flight.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
        for i in range(FRAMES):
            frame = np.ascontiguousarray(ground[:, i * STEP : i * STEP + SIZE[0]])
            writer.write(frame if i % 6 == 0 else cv2.GaussianBlur(frame, (0, 0), 2.5))
        writer.release()
        still = cv2.VideoWriter(str(folder / "still.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
        for _ in range(20):
            still.write(np.ascontiguousarray(ground[:, : SIZE[0]]))
        still.release()

    return made_once("films", make)


def test_sharp_frames_are_taken_as_far_apart_as_wanted(torchrefrac, film, tmp_path):
    before = (film / "flight.avi").read_bytes()

    ended = torchrefrac("import", f"photos={film / 'flight.avi'}", "out=river", "film.overlap=0.8", "focal_px=300")

    assert ended.status == 0, ended.err
    with (tmp_path / "river" / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [int(row["frame"]) for row in rows]
    assert all(number % 6 == 0 for number in numbers)
    assert all(0.4 <= apart * STEP / (0.2 * SIZE[0]) <= 1.7 for apart in np.diff(numbers))
    assert [float(row["seconds"]) for row in rows] == pytest.approx([number / 30.0 for number in numbers], abs=0.04)
    capture = load_capture(tmp_path / "river")
    assert capture.names == tuple(row["name"] for row in rows)
    assert capture.cameras.focal[0].tolist() == [300.0, 300.0]
    assert json.loads((tmp_path / "river" / "capture.json").read_text())["folder"] == "images"
    assert (film / "flight.avi").read_bytes() == before


def test_subtitles_beside_a_film_say_where_and_how_each_frame_was_taken(torchrefrac, film, tmp_path):
    shutil.copy(film / "flight.avi", tmp_path / "DJI_0001.avi")
    blocks = [
        f"{i}\n00:00:{i // 2:02d},{i % 2 * 500:03d} --> 00:00:09,000\n[latitude: {46.8 + 1e-4 * i:.6f}] "
        f"[longitude: 8.0] [rel_alt: {40 + i}.0 abs_alt: {440 + i}.0] [focal_len: 240] "
        "[gb_yaw: 90.0 gb_pitch: -80.0 gb_roll: 0.0]\n\n"
        for i in range(5)
    ]
    (tmp_path / "DJI_0001.SRT").write_text("".join(blocks))

    ended = torchrefrac("import", "photos=DJI_0001.avi", "out=river")

    assert ended.status == 0, ended.err
    with (tmp_path / "river" / "frames.csv").open(newline="") as file:
        seconds = [float(row["seconds"]) for row in csv.DictReader(file)]
    content = json.loads((tmp_path / "river" / "capture.json").read_text())
    positions = np.array([image["position"] for image in content["images"]])
    assert positions[:, 2] == pytest.approx([440.0 + 2.0 * time for time in seconds], abs=0.01)
    assert np.diff(positions[:, 1]) == pytest.approx(22.24 * np.diff(seconds), rel=0.01, abs=0.05)
    assert all(image["down_in_cam"][2] == pytest.approx(np.sin(np.deg2rad(80.0))) for image in content["images"])
    (camera,) = content["cameras"].values()
    assert camera["sigma"]["focal"] == 0.1
    assert "gimbal (subtitles)" in ended.out
    assert "neither EXIF nor XMP" not in ended.out


def test_another_film_takes_the_frames_of_the_first_away(torchrefrac, film, tmp_path):
    torchrefrac("import", f"photos={film / 'flight.avi'}", "out=river")
    first = {path.name for path in (tmp_path / "river" / "images").iterdir()}

    torchrefrac("import", f"photos={film / 'flight.avi'}", "out=river", "film.most=3")

    second = {path.name for path in (tmp_path / "river" / "images").iterdir()}
    assert len(second) == 3 < len(first)


def test_a_film_without_motion_or_frames_is_refused(torchrefrac, film, tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"no film")

    still = torchrefrac("import", f"photos={film / 'still.avi'}", "out=river")
    empty = torchrefrac("import", "photos=empty.mp4", "out=river")

    assert "does not make two photographs: its camera moves by less than 20% of the picture" in still.err
    assert "empty.mp4 cannot be read as a film; convert it to MP4" in empty.err
    assert (still.status, empty.status) == (1, 1)
    assert not (tmp_path / "river").exists()


def test_a_film_among_photographs_is_told(torchrefrac, film, tmp_path):
    ended = torchrefrac("import", f"photos={film}", "out=river")

    assert ended.status == 1
    assert "for the frames of a film name the file: photos=" in ended.err


def test_where_frames_would_be_too_many_they_are_farther_apart():
    looks = [Look(i, i / 10.0, 0.04 * i, 1.0 + (i % 2)) for i in range(101)]

    assert len(choose(looks, 0.2, 1000)) == 21
    assert len(choose(looks, 0.2, 6)) == 6
    assert all(look.number % 2 == 1 for look in choose(looks, 0.2, 1000)[1:-1])
    assert choose([], 0.2, 6) == []
