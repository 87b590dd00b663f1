"""What each maker's devices write, and what it means."""

import math

import pytest

from tests.files.metadata import oracle
from tests.files.metadata.made_photographs import apple_note, dji_note, packet, write_photograph
from torchrefrac.files.metadata.photograph import read_photograph

DJI, PARROT, SENSEFLY = {"Make": "DJI", "Model": "FC6310"}, {"Make": "Parrot"}, {"Make": "senseFly"}
AUTEL, SKYDIO = {"Make": "Autel Robotics"}, {"Make": "Skydio"}
S10, C10 = math.sin(math.radians(10.0)), math.cos(math.radians(10.0))


def gimbal(prefix, yaw, pitch, roll, **others):
    angles = {"Yaw": yaw, "Pitch": pitch, "Roll": roll}
    return packet(**{f"{prefix}__Gimbal{name}Degree": f"{angle:+.2f}" for name, angle in angles.items()}, **others)


def camera(prefix, yaw, pitch, roll, end=""):
    angles = {"Yaw": yaw, "Pitch": pitch, "Roll": roll}
    return packet(**{f"{prefix}__{name}{end}": str(angle) for name, angle in angles.items()})


def skydio(yaw, pitch, roll, as_attributes=False):
    angles = {"Yaw": yaw, "Pitch": pitch, "Roll": roll}
    if not as_attributes:
        return packet(**{f"drone_skydio__CameraOrientationNED__{name}": str(angle) for name, angle in angles.items()})
    inside = " ".join(f'drone-skydio:{name}="{angle}"' for name, angle in angles.items())
    old = f"<drone-skydio:CameraOrientationNED {inside}/>".encode()
    return packet().replace(b"</rdf:Description>", old + b"</rdf:Description>")


@pytest.mark.parametrize(
    ("tags", "xmp", "angles", "looks_down", "sigma"),
    [
        (DJI, gimbal("drone_dji", 44.2, -89.9, 0.0), (44.2, -89.9, 0.0), False, 0.5),
        (DJI, gimbal("drone_dji", -170.0, -60.0, 0.0), (-170.0, -60.0, 0.0), False, 0.5),
        (DJI, gimbal("drone_dji", 10.0, -45.0, 3.0), (10.0, -45.0, 3.0), False, 0.5),
        (DJI, gimbal("drone_dji", 10.0, -85.0, 180.0), (190.0, -95.0, 0.0), False, 0.5),
        (DJI, gimbal("drone_dji", 10.0, -90.0, -180.0), (190.0, -90.0, 0.0), False, 0.5),
        # The aircraft faces elsewhere: it does not count.
        (DJI, gimbal("drone_dji", 80.0, -70.0, 0.0, drone_dji__FlightYawDegree="-95"), (80.0, -70.0, 0.0), False, 0.5),
        (DJI, packet(True, drone_dji__GimbalYawDegree="+84.20", drone_dji__GimbalPitchDegree="-44.50",
                     drone_dji__GimbalRollDegree="+0.00"), (84.2, -44.5, 0.0), False, 0.5),
        ({**DJI, "MakerNote": dji_note(44.0, -80.0, 1.0)}, b"", (44.0, -80.0, 1.0), False, 0.5),
        (AUTEL, gimbal("drone", 30.0, -75.0, 1.0), (30.0, -75.0, 1.0), False, 0.5),
        (AUTEL, camera("Camera", 30.0, -75.0, 1.0), (30.0, -75.0, 1.0), False, 0.5),  # Pix4D's tags, DJI's angles
        (PARROT, camera("drone_parrot", 176.31, -78.36, -0.32, "Degree").replace(b":Yaw", b":CameraYaw")
         .replace(b":Pitch", b":CameraPitch").replace(b":Roll", b":CameraRoll"), (176.31, -78.36, -0.32), False, 0.5),
        (PARROT, camera("Camera", 120.0, 12.0, 2.0), (120.0, 12.0, 2.0), True, 0.5),
        (SENSEFLY, camera("Camera", 120.0, 5.0, 4.0), (120.0, 5.0, -4.0), True, 3.0),
        ({"Make": "MicaSense"}, camera("Camera", 120.0, 5.0, 4.0), (120.0, 5.0, 4.0), True, 3.0),
        (SKYDIO, skydio(77.0, -50.0, 0.5), (77.0, -50.0, 0.5), False, 0.5),
        (SKYDIO, skydio(77.0, -50.0, 0.5, as_attributes=True), (77.0, -50.0, 0.5), False, 0.5),
    ],
)  # fmt: skip
def test_a_drone_s_camera_is_turned_as_its_maker_says(tmp_path, tags, xmp, angles, looks_down, sigma):
    found = read_photograph(write_photograph(tmp_path / "a.jpg", tags, xmp)).attitude

    axes = oracle.camera_axes(*angles, looks_down=looks_down)
    assert found.down_in_cam == pytest.approx(oracle.down_in_cam(axes), abs=1e-6)
    assert found.heading_deg == pytest.approx(oracle.heading_deg(axes), abs=1e-4)
    assert found.sigma_deg == sigma


@pytest.mark.parametrize(
    ("tags", "xmp"),
    [
        ({**DJI, "MakerNote": dji_note(44.0, math.nan, 1.0)}, b""),
        (DJI, gimbal("drone_dji", 0.0, 0.0, 0.0)),  # what a camera without a gimbal writes
        (DJI, packet(drone_dji__GimbalPitchDegree="-90", drone_dji__GimbalRollDegree="unknown")),
        (DJI, packet(drone_dji__FlightYawDegree="10", drone_dji__FlightPitchDegree="-3")),
        (PARROT, camera("Camera", 0, 0, 0)),
        (DJI, b""),
        ({}, b""),
    ],
)
def test_what_says_nothing_is_not_taken_for_gravity(tmp_path, tags, xmp):
    assert read_photograph(write_photograph(tmp_path / "a.jpg", tags, xmp)).attitude is None


def test_without_a_yaw_gravity_is_known_and_the_heading_is_not(tmp_path):
    xmp = packet(drone_dji__GimbalPitchDegree="-60", drone_dji__GimbalRollDegree="0")

    found = read_photograph(write_photograph(tmp_path / "a.jpg", DJI, xmp)).attitude

    assert found.down_in_cam == pytest.approx((0.0, 0.5, math.sin(math.radians(60.0))))
    assert found.heading_deg is None


@pytest.mark.parametrize("roll", [150.0, 180.0, -180.0])
def test_a_gimbal_that_went_past_straight_down_is_told(tmp_path, roll):
    path = write_photograph(tmp_path / "a.jpg", DJI, gimbal("drone_dji", 0.0, -85.0, roll))

    assert read_photograph(path).is_past_nadir
    assert not read_photograph(write_photograph(path, DJI, gimbal("drone_dji", 0.0, -85.0, 90.0))).is_past_nadir


IPHONE = {"Make": "Apple", "Model": "iPhone 12 Pro", "LensModel": "iPhone 12 Pro back triple camera"}


@pytest.mark.parametrize(
    ("axes", "orientation", "size", "down"),
    [
        # Flat on a glass table, the camera below: straight down.
        ((0.0, 0.0, -1.0), 6, (96, 72), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, -1.0), 1, (96, 72), (0.0, 0.0, 1.0)),
        # Held upright and leant forward by 10 degrees: gravity goes down the phone, to the right edge of the sensor.
        ((0.0, -C10, -S10), 6, (96, 72), (C10, 0.0, S10)),
        # Held across, the top to the left: gravity goes to the left edge of the phone, the lower one of the sensor.
        ((-C10, 0.0, -S10), 1, (96, 72), (0.0, C10, S10)),
        # Held across, the top to the right: the sensor is upside down.
        ((C10, 0.0, -S10), 3, (96, 72), (0.0, -C10, S10)),
        # The same as the third, but the pixels were turned by some program.
        ((S10, -C10, 0.0), 1, (72, 96), (S10, C10, 0.0)),
    ],
)
def test_an_iphone_s_gravity_is_in_the_axes_of_its_sensor(tmp_path, axes, orientation, size, down):
    tags = {**IPHONE, "Orientation": orientation, "MakerNote": apple_note(*axes)}

    found = read_photograph(write_photograph(tmp_path / "a.jpg", tags, size=size)).attitude

    assert found.down_in_cam == pytest.approx(down, abs=2e-4)
    assert (found.heading_deg, found.sigma_deg) == (None, 1.0)


@pytest.mark.parametrize(
    "tags",
    [
        {**IPHONE, "MakerNote": apple_note(0.3, -0.9, -0.9)},  # shaken
        {**IPHONE, "MakerNote": apple_note(0.0, -0.6, -0.8), "LensModel": "iPhone 12 Pro front camera"},
        {**IPHONE, "MakerNote": b"Apple iOS\0\0\1MM\0\7\0\1"},  # cut off
        {**IPHONE, "MakerNote": b"something else"},
        IPHONE,
    ],
)
def test_an_iphone_that_was_shaken_or_says_nothing_has_no_gravity(tmp_path, tags):
    assert read_photograph(write_photograph(tmp_path / "a.jpg", tags)).attitude is None


@pytest.mark.parametrize(
    ("comment", "orientation", "down"),
    [
        ("Yaw:120.5,Pitch:-90.0,Roll:0.0", 1, (0.0, 0.0, 1.0)),
        ("Yaw:120.5,Pitch:-80.0,Roll:0.0", 1, (0.0, S10, C10)),
        ("Yaw:120.5,Pitch:-80.0,Roll:0.0", 6, (S10, 0.0, C10)),
        ("Yaw:120.5,Pitch:-80.0,Roll:0.0", 3, (0.0, -S10, C10)),
        ("Yaw:120.5,Pitch:-80.0,Roll:0.0", 8, (-S10, 0.0, C10)),
        ("Yaw:120.5,Pitch:0.0,Roll:10.0", 1, (S10, C10, 0.0)),  # right side down
    ],
)
def test_open_camera_s_angles_are_those_of_the_image_as_shown(tmp_path, comment, orientation, down):
    tags = {"Make": "Google", "Orientation": orientation, "UserComment": b"ASCII\0\0\0" + comment.encode()}

    found = read_photograph(write_photograph(tmp_path / "a.jpg", tags)).attitude

    assert found.down_in_cam == pytest.approx(down, abs=1e-6)


def test_gravity_of_a_mirrored_photograph_is_not_used(tmp_path):
    tags = {"Make": "Google", "Orientation": 2, "UserComment": b"ASCII\0\0\0Yaw:1,Pitch:-80,Roll:0"}

    assert read_photograph(write_photograph(tmp_path / "a.jpg", tags)).attitude is None
