"""What import prints: a hundred columns, sources that differ in lines of their own, long lists cut."""

from torchrefrac.record.import_lines import import_lines

CAMERA = {"photographs": 3, "width": 4000, "height": 3000, "fx": 2900.0, "fy": 2900.0, "cx": 2001.5, "cy": 1500.0,
          "focal_sigma": 0.01, "focal": "XMP drone-dji:DewarpData", "principal_point": "XMP drone-dji:DewarpData",
          "principal_point_sigma": 8.0, "distortion": "XMP drone-dji:DewarpData", "distortion_sigma": None}  # fmt: skip


def report(**others):
    return {
        "used": 3, "left_out": {}, "folder": "/card/DCIM", "out": "/river", "cameras": {"M3E_12.3mm_4000x3000": CAMERA},
        "gravity": {"gimbal (XMP drone-dji)": 2, "table": 1}, "gravity_sigma_deg": 0.5, "heading": {}, "position": {},
        "position_sigma": None, "crs": None, "north_deg": 0.0, "vertical": None, "altitude_range": None, "height": 0,
        "without_position": {}, "notes": [],
    } | others  # fmt: skip


def row(lines, label):
    """The words of the line that begins so, and of the one below."""
    at = next(i for i, line in enumerate(lines) if line.split()[:1] == [label])
    return " ".join(lines[at].split()), " ".join(lines[at + 1].split())


def test_each_source_has_a_line_and_what_is_missing_says_so():
    lines = import_lines(report())

    assert row(lines, "gravity") == (
        "gravity 2 of 3 +- 0.5 degrees gimbal (XMP drone-dji)",
        "1 of 3 +- 0.5 degrees table",
    )
    assert row(lines, "heading")[0] == "heading 0 of 3 not found: nothing needs it"
    assert row(lines, "focal")[0] == "focal length 2900.0 px +- 1 % XMP drone-dji:DewarpData"
    assert row(lines, "principal")[0].startswith("principal point +1.5, +0.0 px +- 8 px XMP")
    assert row(lines, "height")[0] == "height 0 of 3 not found: give water_level or take_off_above_water"


def test_names_with_one_reason_stand_together_and_long_lists_are_cut():
    left_out = {f"DJI_{i:04d}_T.JPG": "thermal" for i in range(30)} | {f"{i}.jpg": f"reason {i}" for i in range(30)}

    lines = import_lines(report(left_out=left_out, notes=["a note of many words " * 12]))

    assert "  DJI_0000_T.JPG, DJI_0001_T.JPG, DJI_0002_T.JPG and 27 more: thermal" in lines
    assert "  and 19 reasons more, in import.json" in lines
    assert max(map(len, lines)) <= 100
    assert lines[0].endswith(", 60 left out")
