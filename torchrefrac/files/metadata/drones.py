"""Which way a drone's camera was turned, by the XMP or maker note of its maker."""

from torchrefrac.files.metadata.attitude import Attitude, Mount
from torchrefrac.files.metadata.exif import Exif
from torchrefrac.files.metadata.xmp import Xmp

SIGMA_DEG = 0.5
"""Of a gimbal's vertical: makers state 0.01 to 0.1 degrees of vibration, but the horizon of the inertial unit drifts by
some tenths with each manoeuvre."""
MOUNTED_SIGMA_DEG = 3.0  # of a camera that is fixed in an aircraft, whose attitude is filtered
FROM_THE_HORIZON = -30.0  # degrees; no camera that counts from straight down looks so far backwards

GIMBALS = {
    "drone-dji": ("drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree"),
    "drone": ("drone:GimbalYawDegree", "drone:GimbalPitchDegree", "drone:GimbalRollDegree"),
    "drone-autel": ("drone-autel:GimbalYawDegree", "drone-autel:GimbalPitchDegree", "drone-autel:GimbalRollDegree"),
    "drone-parrot": (
        "drone-parrot:CameraYawDegree", "drone-parrot:CameraPitchDegree", "drone-parrot:CameraRollDegree",
    ),
    "drone-skydio": tuple(f"drone-skydio:CameraOrientationNED/{angle}" for angle in ("Yaw", "Pitch", "Roll")),
}  # fmt: skip
"""Names of yaw, pitch and roll: pitch 0 at the horizon and -90 straight down, yaw that of the camera, clockwise from
true north. `FlightYawDegree` and the like are the aircraft's, which may be turned otherwise."""


def attitude_of(exif: Exif, xmp: Xmp) -> Attitude | None:
    """None where the file has no angles, or all are 0: cameras without a gimbal write that."""
    for maker, names in GIMBALS.items():
        found = gimbal_attitude([xmp.number(name) for name in names], f"gimbal (XMP {maker})")
        if found is not None:
            return found
    return _mounted(exif, xmp) or gimbal_attitude(
        [exif.number(f"MakerNote Camera{angle}") for angle in ("Yaw", "Pitch", "Roll")]
        if exif.text("Image Make").upper() == "DJI"
        else [],
        "gimbal (maker note)",
    )


def gimbal_attitude(angles: list[float | None], source: str) -> Attitude | None:
    """From yaw, pitch and roll in degrees; without a heading where there is no yaw. None where one of the others is
    missing, or all are 0."""
    yaw, pitch, roll = angles if len(angles) == 3 else (None, None, None)
    if pitch is None or roll is None or not any(angles):
        return None
    found = Attitude.of_angles(yaw or 0.0, pitch, roll, SIGMA_DEG, source)
    return found if yaw is not None else Attitude(found.down_in_cam, None, SIGMA_DEG, source)


def _mounted(exif: Exif, xmp: Xmp) -> Attitude | None:
    """Angles of Pix4D's kind, "Camera:Yaw": pitch 0 straight down, but from the horizon by some makers. senseFly counts
    roll the other way round."""
    yaw, pitch, roll = (xmp.number(f"Camera:{angle}") for angle in ("Yaw", "Pitch", "Roll"))
    if yaw is None or pitch is None or roll is None or not (yaw or pitch or roll):
        return None
    maker = (exif.text("Image Make") or xmp.text("tiff:Make")).lower()
    if pitch < FROM_THE_HORIZON:
        return Attitude.of_angles(yaw, pitch, roll, SIGMA_DEG, "gimbal (XMP Camera)")
    sigma, roll = (SIGMA_DEG, roll) if maker.startswith("parrot") else (MOUNTED_SIGMA_DEG, roll)
    if maker.startswith("sensefly"):
        roll = -roll
    return Attitude.of_angles(yaw, pitch, roll, sigma, "aircraft (XMP Camera)", Mount.DOWN)
