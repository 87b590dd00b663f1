"""Files that are damaged, of another kind, or made to do harm."""

import struct

import pytest
from PIL import Image

from tests.files.metadata.made_photographs import NAMESPACES, packet, picture, write_photograph
from torchrefrac.files.metadata.exif import Exif
from torchrefrac.files.metadata.header import MOST_PIXELS, read_header
from torchrefrac.files.metadata.kinds import Kind, left_out_by_kind, unreadable
from torchrefrac.files.metadata.photograph import read_photograph
from torchrefrac.files.metadata.xmp import Xmp
from torchrefrac.files.photographs import DamagedPhotographError
from torchrefrac.scene import CaptureError


@pytest.mark.parametrize(
    ("name", "size", "xmp", "kind"),
    [
        ("DJI_0001.JPG", (96, 72), {}, Kind.ORDINARY),
        ("DJI_20240101120000_0001_T.JPG", (96, 72), {}, Kind.THERMAL),
        ("DJI_20240101120000_0001_W.JPG", (96, 72), {}, Kind.ORDINARY),
        ("DJI_20240101120000_0001_V.JPG", (96, 72), {}, Kind.ORDINARY),
        ("DJI_20240101120000_0001_Z.JPG", (96, 72), {}, Kind.ZOOM),
        ("DJI_0001_THRM.jpg", (96, 72), {}, Kind.THERMAL),
        ("river_t.jpg", (96, 72), {"drone_dji__ImageSource": "WideCamera"}, Kind.ORDINARY),
        ("DJI_0001.JPG", (96, 72), {"drone_dji__ImageSource": "InfraredCamera"}, Kind.THERMAL),
        ("DJI_0001.JPG", (96, 72), {"drone_dji__ImageSource": "ZoomCamera"}, Kind.ZOOM),
        ("DJI_20240101120000_0001_MS_NIR.TIF", (96, 72), {}, Kind.BAND),
        ("DJI_20240101120000_0001_D.JPG", (96, 72), {}, Kind.ORDINARY),
        ("IMG_0001_3.tif", (96, 72), {"Camera__BandName": "Green"}, Kind.BAND),
        ("DJI_0001.JPG", (96, 72), {"GPano__ProjectionType": "equirectangular"}, Kind.PANORAMA),
        ("DJI_0001.JPG", (240, 72), {}, Kind.PANORAMA),
        ("DJI_0001.JPG", (72, 240), {}, Kind.PANORAMA),
        ("DJI_0001.JPG", (128, 72), {}, Kind.ORDINARY),  # 16:9
        ("IMG_0001.JPG", (96, 48), {}, Kind.ORDINARY),  # 18:9 of a phone
    ],
)
def test_the_kind_of_a_picture_is_told_by_its_file_or_its_name(tmp_path, name, size, xmp, kind):
    path = write_photograph(tmp_path / name, {}, packet(**xmp) if xmp else b"", size)

    assert read_photograph(path).kind is kind


N, Z, T, P, B = Kind.ORDINARY, Kind.ZOOM, Kind.THERMAL, Kind.PANORAMA, Kind.BAND


@pytest.mark.parametrize(
    ("kinds", "stay"),
    [
        ((N, N), (0, 1)),
        ((N, T, Z, N), (0, 3)),
        ((Z, Z, T), (0, 1)),
        ((T, T), (0, 1)),
        ((N, P), (0,)),
        ((P, P), ()),
        ((N, B), (0,)),
        ((B, B), (0, 1)),
    ],
)
def test_one_kind_of_picture_stays_and_the_others_have_a_reason(kinds, stay):
    reasons = left_out_by_kind(kinds)

    assert tuple(i for i, reason in enumerate(reasons) if not reason) == stay


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.DNG", "its picture is taken"),
        ("b.DNG", "convert it to TIFF with dcraw"),
        ("b.heic", "convert it to JPEG with heif-convert"),
        ("b.CR3", "raw data"),
    ],
)
def test_what_cannot_be_read_names_the_program_that_converts_it(tmp_path, name, words):
    assert words in unreadable(tmp_path / name, {str(tmp_path / "a").lower()})


def test_xmp_with_entities_is_refused_before_it_is_read(tmp_path):
    bomb = b'<!DOCTYPE lol [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]>'
    found = Xmp(packet(drone_dji__GimbalYawDegree="1").replace(b"<x:xmpmeta", bomb + b"<x:xmpmeta"))

    assert not found
    assert "other than any camera writes" in found.problem


@pytest.mark.parametrize("cut", [0.3, 0.6, 0.9])
def test_xmp_that_is_cut_off_says_nothing_but_that_it_is_damaged(tmp_path, cut):
    whole = packet(drone_dji__GimbalPitchDegree="-90", drone_dji__GimbalRollDegree="1", drone_dji__GimbalYawDegree="3")
    path = write_photograph(tmp_path / "a.jpg", {"Make": "DJI"}, whole[: int(cut * len(whole))])

    found = read_photograph(path)

    assert found.attitude is None
    assert found.notes == ("its XMP is damaged",)


def test_the_prefix_that_a_packet_gives_to_a_namespace_counts():
    text = packet(drone_dji__RtkFlag="50", as_elements=True).replace(b'xmlns:tiff="', b'xmlns:other="')

    assert Xmp(text).number("drone-dji:RtkFlag") == 50.0
    assert NAMESPACES["tiff"].encode() in text


@pytest.mark.parametrize(("text", "number"), [("12/8", 1.5), ("+3.5", 3.5), ("1/0", None), ("inf", None), ("", None)])
def test_numbers_of_xmp_are_decimals_or_fractions(text, number):
    assert Xmp(packet(Camera__Yaw=text)).number("Camera:Yaw") == number


@pytest.mark.parametrize("text", ["Green", "<rdf:Seq><rdf:li>Green</rdf:li></rdf:Seq>"])
def test_a_text_may_stand_in_a_list(text):
    assert Xmp(packet(True, Camera__BandName=text)).text("Camera:BandName") == "Green"


def test_structures_without_end_do_not_exhaust_the_stack():
    nested = packet(True, Camera__A="<Camera:A>" * 20_000 + "</Camera:A>" * 20_000, Camera__Yaw="3")

    assert Xmp(nested).number("Camera:Yaw") == 3.0


@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff\xe0 no more", b"text", b"II*\0\x08\0\0\0\xff\xff"])
def test_what_is_no_image_is_damaged(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)

    with pytest.raises(DamagedPhotographError, match=r"a.jpg cannot be read as an image"):
        read_photograph(tmp_path / "a.jpg")


def test_a_file_that_ends_too_early_is_damaged(tmp_path):
    path = write_photograph(tmp_path / "a.jpg", {"Make": "DJI"})
    path.write_bytes(path.read_bytes()[:-200])

    with pytest.raises(DamagedPhotographError, match="ends before its image does"):
        read_photograph(path)


def test_an_image_of_impossible_size_is_refused_before_it_is_decoded(tmp_path):
    path = tmp_path / "a.tif"
    picture((64, 48)).save(path)
    content = bytearray(path.read_bytes())
    with Image.open(path) as image:
        directory = image._ifd_offset if hasattr(image, "_ifd_offset") else struct.unpack_from("<I", content, 4)[0]
    (count,) = struct.unpack_from("<H", content, directory)
    for entry in range(directory + 2, directory + 2 + 12 * count, 12):
        if struct.unpack_from("<H", content, entry)[0] in (256, 257):
            struct.pack_into("<HHII", content, entry, struct.unpack_from("<H", content, entry)[0], 4, 1, 60_000)
    path.write_bytes(content)

    with pytest.raises(CaptureError, match=r"says that it has 60000x60000 pixels"):
        read_header(path)
    assert MOST_PIXELS < 60_000**2


def test_a_maker_note_of_billions_of_entries_ends_soon(tmp_path):
    note = b"Apple iOS\0\0\1MM" + bytes(2000)
    path = write_photograph(tmp_path / "a.jpg", {"Make": "Apple", "MakerNote": note})
    content = path.read_bytes()
    order = ">" if b"MM\0*" in content[:40] else "<"
    at = content.index(struct.pack(f"{order}H", 0x927C))
    path.write_bytes(content[: at + 4] + struct.pack(f"{order}I", 0xFFFFFFF0) + content[at + 8 :])

    assert Exif(path).maker_note == b""
    assert Exif(path).text("Image Make") == "Apple"


def test_a_file_without_exif_has_no_tags(tmp_path):
    found = read_photograph(write_photograph(tmp_path / "a.png"))

    assert not found.has_tags
    assert (found.attitude, found.fix, found.body, found.time) == (None, None, ("", "", ""), "")
