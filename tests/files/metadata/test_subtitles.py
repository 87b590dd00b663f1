"""Subtitles by DJI: what their lines say, as drones have written them over the years, and what lies between two."""

from pathlib import Path

import numpy as np
import pytest

from tests.files.metadata.made_photographs import write_photograph
from torchrefrac.files.metadata.photograph import read_photograph
from torchrefrac.files.metadata.position import Vertical
from torchrefrac.files.metadata.subtitles import read_subtitles, subtitles_beside

LINES = {
    "each frame, with a gimbal": (
        "FrameCnt: 1, DiffTime: 33ms\n2023-06-01 12:00:00.123\n[iso: 100] [shutter: 1/640.0] [fnum: 2.8] [ev: 0] "
        "[color_md: default] [focal_len: 24.00] [dzoom_ratio: 1.00], [latitude: 59.302335] [longitude: 18.203059] "
        "[rel_alt: 1.300 abs_alt: 132.860] [ct: 5256] [gb_yaw: 130.6 gb_pitch: -26.5 gb_roll: 0.1] ",
        {"latitude": 59.302335, "longitude": 18.203059, "take_off": 1.3, "sea_level": 132.86, "focal": 24.0,
         "yaw": 130.6, "pitch": -26.5, "roll": 0.1},
    ),
    "without a gimbal": (
        "SrtCnt : 1, DiffTime : 33ms\n[iso : 100] [fnum : 280] [focal_len : 240] [latitude: -38.074966] "
        "[longitude: 141.845763] [rel_alt: 40.800 abs_alt: 111.639]",
        {"latitude": -38.074966, "longitude": 141.845763, "take_off": 40.8, "sea_level": 111.639, "focal": 24.0},
    ),
    "misspelt": (
        "2020-04-02 15:19:58,720,764\n[iso : 400] [focal_len : 280] [dzoom_ratio: 10000, delta:0] [latitude : 31.45] "
        "[longtitude : -74.4] [altitude: 213.98]",
        {"latitude": 31.45, "longitude": -74.4, "sea_level": 213.98, "focal": 28.0},
    ),
    "zoomed by cutting": (
        "[focal_len: 24.00] [dzoom_ratio: 1.18] [latitude: 1.5] [longitude: 2.5]",
        {"latitude": 1.5, "longitude": 2.5},
    ),
    "each second": (
        "HOME(149.0251,-20.2532) 2017.08.05 14:11:51\nGPS(149.0251,-20.2533,16) BAROMETER:1.9\nISO:100 Fnum:F2.8",
        {"longitude": 149.0251, "latitude": -20.2533, "take_off": 1.9},
    ),
    "one line": (
        "F/5.6, SS 400, ISO 100, EV 0, GPS (-58.851745, -34.237922, 15), HOME (-58.847509, -34.232707, -57.98m), "
        "D 698.70m, H 85.80m, H.S 0.00m/s, V.S 0.00m/s, F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)",
        {"longitude": -58.851745, "latitude": -34.237922, "take_off": 85.8, "pitch": -24.4, "roll": 0.0, "yaw": 110.4},
    ),
    "latitude first, and a precision": (
        "GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M",
        {"latitude": 36.6146, "longitude": -6.112, "take_off": 0.3},
    ),
    "latitude first, as the other way round is no place": (
        "GPS(39.906217,116.391305,69.800) BAROMETER(91.2) HOME(39.906206,116.391400)",
        {"latitude": 39.906217, "longitude": 116.391305, "sea_level": 69.8, "take_off": 91.2},
    ),
    "with an altitude": ("GPS(8.2090,47.4692,435.2)", {"longitude": 8.209, "latitude": 47.4692, "sea_level": 435.2}),
    "no fix": ("[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 1.0]", {"take_off": 1.0}),
    "no place": ("[latitude: 95.5] [longitude: 10.0]", {}),
    "exposure alone": ("ISO:100 Shutter:60 EV: Fnum:F2.8", {}),
}  # fmt: skip


def _written(path: Path, *blocks: tuple[str, str], encoding: str = "utf-8", end: str = "\n") -> Path:
    """Subtitles of blocks: when they begin, and their lines."""
    text = "".join(
        f"{i}\n{start} --> 09:00:00,000\n<font>{lines}</font>\n\n" for i, (start, lines) in enumerate(blocks)
    )
    path.write_bytes(text.replace("\n", end).encode(encoding))
    return path


@pytest.mark.parametrize("kind", LINES)
def test_the_lines_of_many_drones_are_read(tmp_path, kind):
    lines, values = LINES[kind]

    found = read_subtitles(_written(tmp_path / "a.srt", ("00:00:01,000", lines)))

    assert found.at(1.0) == pytest.approx(values)


@pytest.mark.parametrize(("encoding", "end"), [("utf-8", "\r\n"), ("utf-8-sig", "\n"), ("utf-16", "\r\n")])
def test_files_may_have_any_ends_of_lines_and_marks(tmp_path, encoding, end):
    block = "00:00:01,000", LINES["each frame, with a gimbal"][0]

    assert (
        read_subtitles(_written(tmp_path / "a.srt", block, encoding=encoding, end=end)).at(1.0)["latitude"] == 59.302335
    )


@pytest.mark.parametrize("content", [b"", b"\x00\xff" * 5000, b"1\n00:00", b"00:00:01,000 -->", b"9" * 100_000])
def test_what_is_no_subtitles_says_nothing(tmp_path, content):
    (tmp_path / "a.srt").write_bytes(content)

    assert read_subtitles(tmp_path / "a.srt").known == {}


@pytest.mark.parametrize(
    ("seconds", "latitude", "yaw"),
    [
        (0.0, 10.0, 350.0),
        (0.25, 10.25, 355.0),
        (1.0, 11.0, 10.0),
        (1.5, 11.5, 0.0),
        (4.5, 12.0, -10.0),
        (-0.5, 10.0, 350.0),
    ],
)
def test_between_two_lines_everything_is_in_proportion(tmp_path, seconds, latitude, yaw):
    lines = [
        ("00:00:00,000", "[latitude: 10] [longitude: 179.9] [gb_yaw: 350.0 gb_pitch: -90 gb_roll: 179]"),
        ("00:00:01,000", "[latitude: 11] [longitude: -179.9] [gb_yaw: 10.0 gb_pitch: -80 gb_roll: -179]"),
        ("00:00:02,000", "[latitude: 12] [longitude: -179.7] [gb_yaw: -10.0 gb_pitch: -80 gb_roll: -179]"),
    ]

    known = read_subtitles(_written(tmp_path / "a.srt", *lines)).at(seconds)

    assert known["latitude"] == pytest.approx(latitude)
    assert np.cos(np.deg2rad(known["yaw"] - yaw)) == pytest.approx(1.0)


def test_a_turn_through_north_and_a_flight_over_the_date_line_take_the_short_way(tmp_path):
    lines = [
        ("00:00:00,000", "[latitude: 10] [longitude: 179.9] [gb_yaw: 350.0 gb_pitch: -80 gb_roll: 180]"),
        ("00:00:01,000", "[latitude: 11] [longitude: -179.9] [gb_yaw: 10.0 gb_pitch: -80 gb_roll: -180]"),
    ]
    photograph = read_photograph(write_photograph(tmp_path / "frame.jpg"))

    found = read_subtitles(_written(tmp_path / "a.srt", *lines))

    known = found.at(0.5)
    assert (known["longitude"] % 360.0, known["yaw"] % 360.0, known["roll"]) == pytest.approx((180.0, 0.0, 180.0))
    told = found.told(photograph, 0.75)
    assert told.fix.longitude == pytest.approx(-179.95)
    assert told.attitude.heading_deg == pytest.approx(185.0)  # upside down


def test_where_lines_are_missing_nothing_is_known(tmp_path):
    found = read_subtitles(
        _written(tmp_path / "a.srt", *((f"00:00:{i:02d},000", "GPS(8,47,16)") for i in (0, 1, 30, 31)))
    )

    assert found.at(15.0) == {}
    assert found.at(40.0) == {}
    assert found.at(30.5) != {}


def test_a_frame_gets_what_it_does_not_say_itself(tmp_path):
    plain = read_photograph(write_photograph(tmp_path / "frame.jpg", size=(160, 90)))
    found = read_subtitles(_written(tmp_path / "a.srt", ("00:00:00,000", LINES["each frame, with a gimbal"][0])))

    told = found.told(plain, 0.0)

    assert (told.fix.latitude, told.fix.longitude, told.fix.source) == (59.302335, 18.203059, "subtitles")
    assert told.fix.altitudes == {Vertical.SEA_LEVEL: 132.86, Vertical.TAKE_OFF: 1.3}
    assert told.fix.sigma == (1.5, 3.0)
    assert (told.attitude.source, told.attitude.sigma_deg) == ("gimbal (subtitles)", 0.5)
    assert told.attitude.down_in_cam[2] == pytest.approx(np.sin(np.deg2rad(26.5)))
    assert told.lens.focal[0] == pytest.approx(24.0 / np.hypot(36.0, 24.0) * 1.25 * 160)
    assert (told.lens.sigma, told.lens.source, told.has_tags) == (0.1, "subtitles, 35 mm equivalent", True)


@pytest.mark.parametrize("focal", ["12.29", "9999.00"])
def test_a_focal_length_that_is_no_equivalent_is_not_believed(tmp_path, focal):
    plain = read_photograph(write_photograph(tmp_path / "frame.jpg", size=(160, 90)))
    found = read_subtitles(_written(tmp_path / "a.srt", ("00:00:00,000", f"[focal_len: {focal}]")))

    assert found.at(0.0) == {"focal": float(focal)}
    assert found.told(plain, 0.0) == plain


def test_subtitles_are_those_with_the_name_of_the_film(tmp_path):
    _written(tmp_path / "DJI_0001.srt", ("00:00:00,000", "GPS(8,47,16)"))
    _written(tmp_path / "DJI_0002.SRT", ("00:00:00,000", "ISO:100"))

    assert subtitles_beside(tmp_path / "DJI_0001.MP4").path.name == "DJI_0001.srt"
    assert subtitles_beside(tmp_path / "DJI_0001.MP4").problem == ""
    assert subtitles_beside(tmp_path / "DJI_0002.MP4").problem.startswith("DJI_0002.SRT says nothing that is read here")
    assert subtitles_beside(tmp_path / "DJI_0003.MP4") is None
