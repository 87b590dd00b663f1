"""The paper's Figures 1, 3, 5 and 6 of runs, with their words."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from torchrefrac.figures.attitude import Angle, attitudes, models_attitude_figure, rms
from torchrefrac.figures.paper import paths_figure, photograph_and_models_figure, setup_figure
from torchrefrac.figures.side_views import MODEL_COLORS, side_view
from torchrefrac.geometry import Rigid
from torchrefrac.html.contents import RunContents
from torchrefrac.html.words import model_title, rounded
from torchrefrac.scene import Capture, Interfaces, Observations, Scene, Truth
from torchrefrac.sweeps.lines import MARKERS


class Made(NamedTuple):
    """A figure, the stem of the names of its files, and its words; see `Drawn`."""

    stem: str
    figure: Any
    title: str
    alt: str
    caption: str
    look: str


def of_synthetic(runs: Mapping[str, RunContents]) -> Iterator[Made]:
    """Figures 1 and 3 of runs of one scene, by their models; none of photographs that are not there."""
    known = next((run for run in runs.values() if run.capture is not None), None)
    if known is None or known.capture is None:
        return
    photograph, truth = known.capture.paths[0], known.truth
    views = [
        replace(view, caption=view.caption.replace(", ", "\n"))
        for model, run in runs.items()
        if run.scene is not None
        for view in [side_view(model, run.scene, run.aligned, run.record.metrics)]
    ]
    yield Made(
        "paper_figure1",
        photograph_and_models_figure(photograph, views, truth),
        "Figure 1. What the water does to a scene",
        f"A photograph, and side views of reconstructions: {', '.join(view.title for view in views)}",
        f"One of {len(known.capture)} photographs, and what the models make of them, from the side and coloured by "
        "height: dark the lowest, light the highest, on one scale. Grey lines are the true planes.",
        "Points belong on the grey lines. In the paper, as here, the bottom is curved without refraction, hardly less "
        "so with radial distortion, and flat with refraction.",
    )
    if truth is not None and len(truth.corner):
        yield Made(
            "paper_figure3",
            setup_figure(_as_it_was(known.capture, truth), truth, photograph, known.words),
            "Figure 3. The synthetic scene",
            "The true planes under the water with the cameras above it, and a photograph",
            "The planes, the surface of the water, and the cameras as the pyramids of what they see, joined in the "
            "order of the photographs.",
            "The cameras stand on an arc close above the water, in turn at two heights.",
        )


def of_photographed(runs: Mapping[str, RunContents]) -> Iterator[Made]:
    """Figures 5 and 6 of runs of one scene, by their models; the latter where gravity was measured."""
    shown = {model: scene for model, run in runs.items() if (scene := run.shown) is not None}
    if not shown:
        return
    known = next(iter(runs.values()))
    titles = ", ".join(map(model_title, shown))
    yield Made(
        "paper_figure5",
        paths_figure({model_title(model): scene for model, scene in shown.items()}, known.truth, known.words),
        "Figure 5. The path of the camera, and what it saw",
        f"Cameras, path and points of {titles}, obliquely and from the side",
        "Obliquely above, from the side below, coloured by height on one scale. The paper's photographs are of a real "
        "tank; these are made, so that the true cameras and planes are known.",
        "The path should run through the crosses, and the checkerboard on the bottom should be flat.",
    )
    found = {model: attitudes(scene, runs[model].capture, runs[model].truth) for model, scene in shown.items()}
    if any(angle.measured is None for _, angles in found.values() for angle in angles[:2]):
        return
    styles = {model_title(model): {"color": MODEL_COLORS[model], "marker": MARKERS[model]} for model in shown}
    count = max(len(scene.views.names) for scene in shown.values())
    yield Made(
        "paper_figure6",
        models_attitude_figure({model_title(model): attitude for model, attitude in found.items()}, styles, count),
        "Figure 6. The attitude of the cameras, and the IMU",
        f"Roll, pitch and heading of each image by {titles}, and as measured",
        f"Roll and pitch: {known.words.dips}. Headings are compared after taking out their mean difference. RMS "
        f"differences from the IMU: {'; '.join(_differences(model, angles) for model, (_, angles) in found.items())}.",
        "With refraction roll and pitch stay as near the IMU as its own errors allow; without, pitch comes out too "
        "small, and heading as with it. So it is in the paper.",
    )


def _differences(model: str, angles: Sequence[Angle]) -> str:
    """RMS differences of what a model finds from what was measured."""
    errors = ((angle.name, angle.error(angle.measured)) for angle in angles)
    parts = [f"{name} {rounded(rms(error))}°" for name, error in errors if error is not None]
    return f"{model_title(model)} {', '.join(parts)}"


def _as_it_was(capture: Capture, truth: Truth) -> Scene:
    """The cameras where they truly stood, without points."""
    views = [capture.names.index(name) for name in truth.names]
    return Scene.create(
        Rigid(truth.rotation, truth.center), capture.cameras, Interfaces.level(1.0), truth.center[:0],
        Observations.none(), names=truth.names, camera=capture.camera[views], length_unit=truth.length_unit,
    )  # fmt: skip
