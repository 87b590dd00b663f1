"""What users know, in CSV files and geo.txt."""

import pytest

from tests.files.metadata import oracle
from torchrefrac.files.metadata.table import read_table
from torchrefrac.scene import CaptureError


@pytest.fixture
def table(tmp_path):
    """`table(text)`: what is read of a file with that text."""

    def read(text, encoding="utf-8"):
        (tmp_path / "table.csv").write_text(text, encoding=encoding)
        return read_table(tmp_path / "table.csv")

    return read


def test_a_csv_says_by_its_columns_what_is_known(table):
    (row,) = table(
        "name,lat,lon,alt,sigma_horizontal,sigma_vertical,yaw,pitch,roll,height,camera\n"
        "a.jpg,46.5,-91.2,201.5,0.02,0.03,30,-60,2,25.5,left\n"
    ).rows.values()

    axes = oracle.camera_axes(30.0, -60.0, 2.0)
    assert (row.degrees, row.altitude, row.sigma) == ((46.5, -91.2), 201.5, (0.02, 0.03))
    assert (row.height, row.camera, row.point) == (25.5, "left", None)
    assert row.attitude.down_in_cam == pytest.approx(oracle.down_in_cam(axes))
    assert row.attitude.heading_deg == pytest.approx(oracle.heading_deg(axes))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_separators_and_marks_of_spreadsheets_are_understood(table, separator, encoding):
    text = "Image,Easting [m],Northing [m],Z\nÜfer/a.jpg,512345.25,5188154.5,201\n".replace(",", separator)

    row = table(text, encoding).rows["Üfer/a.jpg"]

    assert (row.point, row.altitude, row.attitude) == ((512345.25, 5188154.5), 201.0, None)


def test_what_a_row_leaves_empty_is_not_known(table):
    rows = table("name,x,y,z,height\na,1,2,3,\nb,,,,4\n").rows

    assert (rows["a"].point, rows["a"].altitude, rows["a"].height) == ((1.0, 2.0), 3.0, None)
    assert (rows["b"].point, rows["b"].altitude, rows["b"].height) == (None, None, 4.0)


def test_gravity_may_be_stated_as_a_vector_of_any_length(table):
    row = table("name,down_x,down_y,down_z\na,0,3,4\n").rows["a"]

    assert row.attitude.down_in_cam == pytest.approx((0.0, 0.6, 0.8))
    assert row.attitude.heading_deg is None


@pytest.mark.parametrize("crs", ["EPSG:32615", "+proj=utm +zone=15 +datum=WGS84"])
def test_a_geo_txt_has_points_in_its_system_and_angles_of_an_aircraft(table, crs):
    read = table(f"{crs}\na.jpg 576700 5188120 198.6 40 10 3 0.02 0.03\nb.jpg 576710 5188130 198.6\n")

    first, second = read.rows.values()
    axes = oracle.camera_axes(40.0, 10.0, 3.0, looks_down=True)
    assert read.crs == crs
    assert (first.point, first.altitude, first.sigma) == ((576700.0, 5188120.0), 198.6, (0.02, 0.03))
    assert first.attitude.down_in_cam == pytest.approx(oracle.down_in_cam(axes))
    assert (second.point, second.attitude) == ((576710.0, 5188130.0), None)


def test_a_geo_txt_in_degrees_has_the_longitude_first(table):
    read = table("EPSG:4326\na.jpg -91.2 46.5 198.6\n")

    assert (read.crs, read.rows["a.jpg"].degrees, read.rows["a.jpg"].point) == (None, (46.5, -91.2), None)


@pytest.mark.parametrize("name", ["a.jpg", "A.JPG", "flight/a.jpg", "flight\\a.jpg", "a", "a.tif"])
def test_rows_are_found_by_names_with_or_without_folder_and_ending(table, name):
    read = table(f"name,height\n{name},25\n")

    assert [row and row.height for row in read.of(["flight/b.jpg", "flight/a.jpg"])] == [None, 25.0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("lat,lon,alt\n1,2,3\n", "has no column called name"),
        ("name,lat\na,1\n", "has the column latitude without longitude"),
        ("name,down_x,down_y\na,1,2\n", "has the column down_x without down_z"),
        ("name,hieght\na,1\n", "'hieght' is no column that is known here: name, latitude"),
        ("name,height\na,high\n", "line 2: height is 'high', but must be a number"),
        ("# mine\n\nname,height\n\na,high\n", "line 5: height is 'high'"),
        ("name,height\na,-2\n", "line 2: height is -2, but a camera stands above the water"),
        ("name,height\n,2\n", "line 2 has no name"),
        ("name,lat,lon\na,912345,4567\n", "is no latitude and longitude in degrees"),
        ("name,x,y,sigma_h,sigma_v\na,1,2,0,1\n", "a sigma is 0, but must be above 0"),
        ("name,down_x,down_y,down_z\na,0,0,0\n", "down is 0, 0, 0"),
        ("name,height\na,2\na,3\n", "several rows with the same name"),
        ("EPSG:32615\na.jpg 1\n", "line 2 has 2 columns"),
        ("EPSG:32615\na.jpg 1 2 3 4\n", "line 2 has 5 columns"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused_with_its_line(table, text, sentence):
    with pytest.raises(CaptureError, match=sentence) as error:
        table(text)
    assert "\n" not in str(error.value)


def test_a_table_of_other_photographs_is_refused(table):
    with pytest.raises(CaptureError, match=r"names none of the photographs \(it begins with c.jpg\)"):
        table("name,height\nc.jpg,1\n").of(["a.jpg"])
