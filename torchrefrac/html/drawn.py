"""The figures of a run as they stand in its report: picture, what it shows, and what to look for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrefrac.figures.attitude import attitude_figure, attitude_words, attitudes
from torchrefrac.figures.cameras import cameras_figure
from torchrefrac.figures.residuals import Residuals, by_image_figure, by_incidence_figure
from torchrefrac.figures.shift import shift_figure, shift_images, typical_depth, typical_range
from torchrefrac.figures.side_views import SideView, side_view, side_views_figure
from torchrefrac.figures.uncertainty import uncertainty_figure
from torchrefrac.files.run import DENSE_VIEW, ERROR_MAP, PROFILES, SURFACE_VIEW
from torchrefrac.html.contents import RunContents
from torchrefrac.html.page import Picture, picture, png, svg
from torchrefrac.html.words import capital, rounded
from torchrefrac.scene import Scene, Truth
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.wording import Wording
from torchrefrac.sweeps.design import FIGURES

DENSE_WIDTH = 1400
NARROW = 640  # a picture of at most this width is shown whole on a telephone
PANELS_INCHES = 9.2  # of up to three panels of views from the side


@dataclass(frozen=True)
class Drawn:
    """A figure in the page. kind: `wide` ones scroll sideways on a narrow screen rather than shrink."""

    title: str
    picture: Picture
    alt: str
    caption: str
    look: str
    kind: str = "wide"


def draw_models(runs: Sequence[RunContents], titles: Sequence[str] = ()) -> Drawn | None:
    """The view from the side of all runs that have cameras; titles: of panels, by default what models are called."""
    views: list[SideView] = []
    truth: Truth | None = None
    for i, run in enumerate(runs):
        if run.scene is None or not bool(run.scene.views.registered.any()):
            continue
        view = side_view(run.record.model or "?", run.scene, run.aligned, run.record.metrics)
        caption = view.caption.replace(", ", "\n")
        views.append(replace(view, title=titles[i] if titles else view.title, caption=caption))
        truth = truth or run.truth
    if not views:
        return None
    words = views[0].words
    colors = f"{words.ends}, on one scale"
    several = f"{len(views)} reconstructions side by side" if len(views) > 1 else "The reconstruction"
    caption = f"{several} from the side, coloured by {words.value}: {colors}."
    has_planes = truth is not None and len(truth.corner) > 0
    if truth is not None:
        caption += " Moved onto the true cameras as well as possible"
        caption += "; grey lines are the true planes." if has_planes else "."
    return Drawn(
        title="The scene from the side",
        picture=png(side_views_figure(views, truth, PANELS_INCHES / min(max(len(views), 2), 3))),
        alt=f"Side view of the points and cameras of {', '.join(view.title for view in views)}",
        caption=caption,
        look=f"Points should lie on the grey lines. Without refraction in the model {words.flat} comes out bent like a "
        "bowl, too shallow or too deep, and the cameras are off."
        if has_planes
        else f"{capital(words.flat)} should be flat. Without refraction in the model it comes out bent like a bowl.",
        kind=f"wide panels{min(len(views), 4)}",
    )


def draw_cameras(shown: Scene, truth: Truth | None, words: Wording) -> Drawn:
    """The path of the camera."""
    return Drawn(
        title="The path of the camera",
        picture=png(cameras_figure(shown, truth, words)),
        alt=f"Camera path and point cloud {words.along_z} and obliquely",
        caption="Cameras as the pyramids of what they see, joined in the order of the photographs; the points are "
        f"coloured by {words.value}. The first and the last photograph are numbered.",
        look=f"The path should be the one that was {words.taken}, without jumps, and the pyramids should look at the "
        "points." + (" Crosses that lie beside a tip show how far a camera is off." if truth is not None else ""),
    )


def draw_attitude(run: RunContents) -> Drawn | None:
    """Roll, pitch and heading; None where neither measurement nor truth is known."""
    scene = run.shown
    if scene is None:
        return None
    words, (images, angles) = run.words, attitudes(scene, run.capture, run.truth)
    if not len(images) or all(angle.measured is None and angle.true is None for angle in angles):
        return None
    return Drawn(
        title="Attitude of the cameras",
        picture=svg(attitude_figure(images, angles, len(scene.views.names))),
        alt="Estimated, measured and true roll, pitch and heading of each image",
        caption=f"Roll and pitch: {words.dips}. {attitude_words(angles)}"
        + (" Headings are compared after taking out their mean difference." if len(angles) > 2 else ""),
        look="Differences from the IMU should scatter about zero, as large as the IMU's own errors. A trend or an "
        f"offset in roll or pitch says {words.tilted}, or the wrong model.",
    )


def draw_residuals(residuals: Residuals, scene: Scene, words: Wording) -> list[Drawn]:
    """By image and by angle of incidence."""
    what = by_angle = "angle from the vertical" if words.kind == SURFACE else "angle from the z axis"
    if scene.interfaces.refract():
        what, by_angle = words.incidence, f"angle at which the ray met {words.glass} (0° is {words.straight})"
    return [
        Drawn(
            title="Residuals by photograph",
            picture=svg(by_image_figure(residuals, scene.views.registered)),
            alt="Median and ninety per cent bound of the reprojection error of each image",
            caption="Distance between where a point is seen and where the reconstruction puts it, in pixels.",
            look="All about equally low. One photograph that sticks out is blurred, moved, or placed wrongly.",
        ),
        Drawn(
            title="Residuals by angle",
            picture=svg(by_incidence_figure(residuals, what)),
            alt="Reprojection error over the angle of incidence, with the number of observations",
            caption=f"The same over the {by_angle}, and how many observations there are at each.",
            look="A level line. An error that grows with the angle is the mark of refraction that the model does not "
            "have, or of a wrong index ratio.",
        ),
    ]


def draw_shift(run: RunContents) -> Drawn | None:
    """Refraction shift map; None where the model has no refraction or no point lies in water."""
    scene, words = run.scene, run.words
    if scene is None or not scene.interfaces.refract():
        return None
    images, depth = shift_images(scene), typical_depth(scene)
    if scene.interfaces.move_with_camera:  # to which all views look alike
        images, depth = images[:1], typical_range(scene)
    if depth <= 0.0:
        return None
    what = "depth" if words.kind == SURFACE else "distance"
    paths = run.capture.paths if run.capture is not None and run.capture.names == scene.views.names else ()
    return Drawn(
        title=f"How far {words.mover} moves things",
        picture=png(shift_figure(scene, images, depth, paths)),
        alt="Map of the shift by refraction over the image, in pixels",
        caption=f"By how many pixels, and in which direction, refraction moves what lies {rounded(depth, 3)} "
        f"{scene.length_unit} {words.within} (the median {what} of the points).",
        look="These are the errors that a model without refraction has to hide somewhere: compare them with the "
        "residuals of a fraction of a pixel.",
        kind="wide panels1" if len(images) == 1 else "wide",
    )


def draw_uncertainty(shown: Scene, truth: Truth | None, words: Wording) -> Drawn | None:
    """None where the run has no covariances."""
    if shown.assessment.center_covariance is None:
        return None
    figure, factor = uncertainty_figure(shown, truth, words)
    true = " True errors are drawn by the same factor." if truth is not None else ""
    return Drawn(
        title="How well the cameras are determined",
        picture=svg(figure),
        alt=f"Uncertainty ellipses of the camera centres {words.along_z}, and standard deviations of their "
        f"{words.heights}",
        caption=f"Ellipses of one standard deviation of each camera centre, exaggerated {factor:g} times, relative to "
        f"the cameras as a whole.{true}",
        look="Round ellipses of one size; a long one points in the direction that the photographs leave open."
        + (" True errors should mostly be no longer than two standard deviations." if truth is not None else ""),
    )


def draw_dense(folder: Path, words: Wording, own: Wording) -> list[Drawn]:
    """The pictures of a dense stage that lie in the folder, in the words of the frame of the truth and of its own."""
    return _drawn(folder, {}, _dense_pictures(words, own))


def draw_dense_beside(folder: Path, end: str, words: Wording) -> list[Drawn]:
    """The pictures of several dense stages side by side that lie in the folder of a sweep, by what ends their names."""
    _, view, error = (f"{kind}{end}" for kind in FIGURES)
    names = {DENSE_VIEW: view, ERROR_MAP: error}
    return _drawn(folder, names, [one for one in _dense_pictures(words, words) if one[0] in names])


def _drawn(folder: Path, names: Mapping[str, str], pictures: Sequence[tuple[str, str, str, str]]) -> list[Drawn]:
    """Those of the pictures that lie in the folder, some under other names."""
    found = []
    for name, title, caption, look in pictures:
        try:
            shown = picture(folder / names.get(name, name), DENSE_WIDTH)
        except OSError:
            continue
        found.append(Drawn(title, shown, title, caption, look, kind_of(shown)))
    return found


def kind_of(shown: Picture) -> str:
    """Of a picture that lies in a file."""
    return "wide" if shown.width > NARROW else "narrow"


def _dense_pictures(words: Wording, own: Wording) -> tuple[tuple[str, str, str, str], ...]:
    """Files, titles, what they show and what to look for."""
    level = f"{words.line} and " if words.line else ""
    shore = "The shore should lie where the line of the water meets the surface; a" if words.kind == SURFACE else "A"
    light = "the upper left" if words.is_wall else "the north-west"
    return (
        (SURFACE_VIEW, "The surface as it looks",
         f"The dense points as small discs in their planes: in the colours of the photographs, and lit from {light}.",
         "Edges and patterns should be sharp in the colours; grain or steps in the light that the scene does not have "
         "are noise of matching."),
        (DENSE_VIEW, "The dense surface",
         f"The dense points obliquely and from the side, coloured by {words.value}.",
         f"A clean sheet without a haze of points {words.above} or {words.below} it; holes are where the photographs "
         "show no texture."),
        (ERROR_MAP, "Distance of the dense points from the true planes",
         f"{capital(words.along_z)} and from the side: red lies {words.below} the true plane, blue {words.above} it.",
         "Pale everywhere is good. A colour that changes slowly over the scene is a bend; speckle is noise of "
         "matching."),
        ("dsm.png", "Depth of the surface" if words.depth else "The surface as a map",
         f"The dense points as a map seen {own.along_z}, shaded as if lit from one side.",
         "Steps and ripples that the scene does not have come from the reconstruction."),
        (PROFILES, "Sections across the surface",
         f"{capital(own.value)} over distance along three lines across the direction in which the surface is "
         f"longest, with {level}two standard deviations on either side.",
         f"{shore} bend that the {words.ground} does not have comes from a wrong index ratio or camera."),
    )  # fmt: skip
