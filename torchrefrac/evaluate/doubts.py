"""What is stated of photographs and can be right, but hardly is: warnings before anything was compared with images."""

from torchrefrac.scene import Capture, Finding, WarningCode

OFF_CENTER = 0.1
"""Of the size of an image: how far lenses may look past its middle. Few do by more than 0.03."""


def doubts(stated: Capture) -> tuple[Finding, ...]:
    """About each camera whose principal point is where that of a whole photograph never is."""
    cameras = stated.cameras
    found = []
    for i in range(len(cameras)):
        camera = cameras[i]
        (x, y), (width, height) = camera.principal_point.tolist(), (camera.width, camera.height)
        off = max(abs(x / width - 0.5), abs(y / height - 0.5))
        if off > OFF_CENTER:
            message = (
                f"the principal point{cameras.label(i)} is stated at ({x:.1f}, {y:.1f}) from the corner of "
                f"{width}x{height} pixels, {100.0 * off:.0f} % of the size from the middle, as of photographs that "
                "were cut: check cx and cy"
            )
            found.append(Finding(WarningCode.INTRINSICS_CONTRADICT, message))
    return tuple(found)
