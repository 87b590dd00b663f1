"""What the images say against what was stated about them: the warnings of a reconstruction.

Every finding is about the finished scene, whatever the reconstruction made of what was stated. Limits are such that a
right statement is called wrong once in some hundred scenes.
"""

import math
from collections import Counter
from hashlib import sha256

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.refraction.interface import GLASS
from torchrefrac.scene import Capture, Finding, Scene, WarningCode
from torchrefrac.scene.wording import Wording, kind_of, wording
from torchrefrac.sfm.focal import GROSS
from torchrefrac.sfm.gravity import contradicted_gravity, with_common_tilt
from torchrefrac.sfm.heights import fit_heights
from torchrefrac.sfm.stated_places import OTHER_UNIT
from torchrefrac.sfm.vertical import angle_between
from torchrefrac.sfm.walls import gravity_in_world, looks_through_wall, tilt_sigma

FEW, WORSE = 0.5, 4.0
"""Share of the observations of the typical view, and times its error: a view with fewer, larger ones is weak."""
SURE, VERY_SURE = 4.0, 6.0
"""Standard deviations of a wished change; of one that moves keypoints by hundredths of a pixel, as glass of another
thickness does."""
NOTABLE_INDEX, NOTABLE_FOCAL, VAGUE_FOCAL, NOTABLE_GLASS = 0.01, 0.02, 0.2, 0.5
DOUBTFUL = 3.0
"""Standard deviations by which what is stated with a sigma may be off."""
UNCERTAIN = (("focal", "the focal length", " px"), ("principal_point", "the principal point", " px"))
MOSTLY_DRY, VAGUE = 0.5, 0.2
"""Share of the points under water, and error of the index ratio in units of what it is above 1, of a scene in which the
water was put where it does nothing."""
VAGUE_DEG = 1.5
"""Error of verticals that nobody measured beyond which heights are not to be trusted."""
STEEP = 0.002
"""Slope of a surface, radians, from which on it is worth a word."""
FEWEST_DISPUTED, DISPUTED = 20, 0.02
"""Points, and share of all, that contradict where the water is stated to end: near its edge some always do."""
UNDER_WATER = 0.5
"""Typical error under water, as a share of that in air, below which there is water."""
AIR = 1.02
"""An index ratio below which there is no water."""


def contradictions(scene: Scene, stated: Capture) -> tuple[Finding, ...]:
    """All of them, those first that others may follow from. `scene`: what came out, with its assessment; `stated`: what
    went in, the same views in the same order."""
    given, about_files = about_given(scene), (*_damaged(stated), *_duplicates(stated))
    if _lens_is_grossly_wrong(scene):
        return (*given, *about_files)  # what else is wrong follows from that
    if scene.interfaces.stand_in_world:
        about_water = (*_outside_water(scene, stated), *([] if given else _surface(scene)))
        given = (*given, *about_water, *_gravity(scene, stated), *_heights(scene, stated))
    return (*given, *about_files, *about_images(scene))


def about_given(scene: Scene) -> tuple[Finding, ...]:
    """What the images say of the water and the lens. Where the latter is grossly wrong nothing else can be judged."""
    if scene.index_ratio <= 1.0:
        return tuple(_unmodelled(scene))
    intrinsics = _intrinsics(scene)
    about_lens = tuple(intrinsics)
    return (
        about_lens if _lens_is_grossly_wrong(scene) else (*_levels(scene), *about_lens, *_water(scene), *_glass(scene))
    )


def about_images(scene: Scene) -> tuple[Finding, ...]:
    """How well the images, and the adjustment of all, came out."""
    return (*_apart(scene), *_unused_cameras(scene), *_weak_images(scene), *_not_converged(scene))


def _damaged(stated: Capture) -> list[Finding]:
    names = tuple(stated.damaged)
    if not names:
        return []
    message = f"{listed(names)} could not be read and was left out: {stated.damaged[names[0]]}"
    return [Finding(WarningCode.DAMAGED_IMAGE, message, names)]


def _duplicates(stated: Capture) -> list[Finding]:
    """Files with the same content; only those of the same size are read."""
    sizes = Counter(path.stat().st_size for path in stated.paths if path.is_file())
    groups: dict[bytes, list[str]] = {}
    for name, path in zip(stated.names, stated.paths, strict=True):
        if path.is_file() and sizes[path.stat().st_size] > 1:
            groups.setdefault(sha256(path.read_bytes()).digest(), []).append(name)
    return [
        Finding(
            WarningCode.DUPLICATE_IMAGE,
            f"{listed(tuple(names))} are the same photograph: more copies add nothing, and make it look more certain",
            tuple(names),
        )
        for names in groups.values()
        if len(names) > 1
    ]


def _glass(scene: Scene) -> list[Finding]:
    """Of a wall or port: glass that is missing in what was stated, or has another thickness."""
    step, sigma = scene.assessment.wished.get("layer_thickness", (0.0, 1.0))
    stated, unit = float(scene.interfaces.thickness.max()) if scene.interfaces.has_layers else 0.0, scene.length_unit
    if abs(step) <= (max(VERY_SURE * sigma, NOTABLE_GLASS * stated) if stated else DOUBTFUL * sigma):
        return []
    seen = f"{max(stated + step, 0.0):.2g} {unit} +- {sigma:.1g} of glass (index {GLASS:g})"
    what = f"{stated:.3g} {unit} are stated" if stated else "none is stated"
    message = (
        f"the images ask for {seen} before the water, but {what}: state its thickness and index among the layers of "
        "the interface, or check the stated distances and the intrinsics"
    )
    return [Finding(WarningCode.INDEX_CONTRADICTS, message)]


def _wall(scene: Scene, stated: Capture) -> list[Finding]:
    """A wall that gravity does not find upright."""
    found = gravity_in_world(scene, stated)
    if found is None:
        return []
    gravity, sigma = found
    tilt, doubt = math.asin(min(abs(float(gravity[2])), 1.0)), math.hypot(sigma, tilt_sigma(stated))
    if tilt <= DOUBTFUL * doubt:
        return []
    message = (
        f"the wall is {math.degrees(tilt):.1f} degrees from upright by down_in_cam, but is stated to stand upright to "
        f"{math.degrees(doubt):.1f} degrees; its normal was taken from the refraction: check down_in_cam, or state "
        "tilt_sigma_deg of the wall"
    )
    return [Finding(WarningCode.GRAVITY_CONTRADICTS, message)]


def _gravity(scene: Scene, stated: Capture) -> list[Finding]:
    if looks_through_wall(stated):
        return _wall(scene, stated)
    if not stated.has_gravity:
        known = math.degrees(math.inf if scene.capture is None else scene.capture.typical_down_sigma)
        if known <= VAGUE_DEG:
            return []
        message = (
            f"down_in_cam is not stated, and pairs of images show which way is down to {known:.1f} degrees only: "
            "heights and depths may be off by some percent, slopes by as much; measure down_in_cam"
        )
        return [Finding(WarningCode.GRAVITY_UNDETERMINED, message)]
    wrong = contradicted_gravity(scene, stated.down_in_cam, with_common_tilt(scene, stated.down_sigma))
    names = named(scene.views.names, wrong)
    if not names:
        return []
    degrees = angle_between(scene.down_in_cam[wrong], stated.down_in_cam[wrong]).rad2deg()
    off = f"{float(degrees.median()):.1f} degrees (median)" if len(names) > 1 else f"{float(degrees[0]):.1f} degrees"
    known = float(torch.rad2deg(stated.down_sigma)[wrong].median())
    message = (
        f"down_in_cam of {listed(names)} is {off} from the vertical that the images show, but is stated to be known "
        f"to {known:.2g} degrees; it was not used: check its signs and axes (x right, y down, z forward)"
    )
    return [Finding(WarningCode.GRAVITY_CONTRADICTS, message, names)]


def _heights(scene: Scene, stated: Capture) -> list[Finding]:
    measured = scene.views.registered & stated.has_height
    found, heights, unit = scene.views.center[measured, 2], stated.height[measured], scene.length_unit
    words = _words(scene)
    if not bool(measured.any()):
        return []
    fit = fit_heights(found, heights, stated.height_sigma[measured])
    if scene.assessment.surveyed is not None and float(fit.offset) == 0.0:
        ratio = float(fit.scale)
        if max(ratio, 1.0 / ratio) > OTHER_UNIT:
            message = (
                f"heights are stated to be {ratio:.4g} times what they are with the scale of the survey: check the "
                "units of both, and what heights are counted from; the scale is that of the survey"
            )
            return [Finding(WarningCode.HEIGHT_CONTRADICTS, message)]
    if int(measured.sum()) < 2:
        return []
    if float(fit.offset) != 0.0:
        message = (
            f"all {words.heights} are too {'large' if float(fit.offset) > 0.0 else 'small'} by "
            f"{abs(float(fit.offset)):.3g} {unit}, as if they were not counted from {words.glass}; the scale was taken "
            "from their differences"
        )
        return [Finding(WarningCode.HEIGHT_CONTRADICTS, message)]
    wrong = measured.clone()
    wrong[measured] = ~fit.agrees
    names = named(scene.views.names, wrong)
    if not names:
        return []
    told = zip(names, stated.height[wrong].tolist(), scene.views.center[wrong, 2].tolist(), strict=True)
    shown = ", ".join(
        f"{name}: {there:.4g} {unit} stated, {here:.4g} {unit} found" for name, there, here in [*told][:3]
    )
    height = "distance from the glass" if words.is_wall else "height"
    message = (
        f"the {height} of {listed(names)} does not fit those of the others ({shown}); it was not used for the scale"
    )
    return [Finding(WarningCode.HEIGHT_CONTRADICTS, message, names)]


def _levels(scene: Scene) -> list[Finding]:
    """Photographs of two days."""
    levels, unit = scene.assessment.levels, scene.length_unit
    if levels is None:
        return []
    names = named(scene.views.names, levels != 0.0)
    higher, others = float(levels[levels != 0.0].mean()), scene.views.num_registered - len(names)
    message = (
        f"the water stood {abs(higher):.3g} {unit} {'higher' if higher > 0.0 else 'lower'} when {listed(names)} were "
        f"taken than for the other {others} images, but one level was taken for all, so that cameras and points are "
        "wrong: state the epoch of each image, or reconstruct the two groups apart"
    )
    if _words(scene).is_wall:
        message = (
            f"the glass stood {abs(higher):.3g} {unit} {'nearer' if higher > 0.0 else 'farther'} when {listed(names)} "
            f"were taken than for the other {others} images, but one wall was taken for all, so that cameras and "
            "points are wrong: reconstruct the two groups apart"
        )
    return [Finding(WarningCode.WATER_LEVEL_CONTRADICTS, message, names)]


def _weak_images(scene: Scene) -> list[Finding]:
    support, registered = scene.support(), scene.views.registered
    rows = scene.accepted
    errors, view = scene.errors()[rows], scene.observations.view[rows]
    found = registered.nonzero()[:, 0].tolist()
    if len(found) < 3 or not len(errors):
        return []
    typical = torch.full((len(registered),), torch.nan, dtype=errors.dtype)
    for i in found:
        if bool((view == i).any()):
            typical[i] = errors[view == i].median()
    usual, count = typical[registered].nanmedian(), support[registered].double().median()
    weak = registered & (typical > WORSE * usual) & (support < FEW * count)
    return [
        Finding(
            WarningCode.WEAK_IMAGE,
            f"{scene.views.names[i]} agrees worse than the others: {int(support[i])} observations with an error of "
            f"{float(typical[i]):.2g} px (median), the others {int(count)} with {float(usual):.2g} px",
            (scene.views.names[i],),
        )
        for i in weak.nonzero()[:, 0].tolist()
    ]


def _apart(scene: Scene) -> list[Finding]:
    """Reconstructions of images that nothing ties to the others."""
    findings = []
    for number, other in enumerate(scene.further, start=2):
        names = named(other.views.names, other.views.registered)
        message = (
            f"{listed(names)} are a reconstruction of their own, the {number}., as nothing ties them to the others: "
            "state positions of two images or more of each that are apart, or take photographs that show parts of both"
        )
        findings.append(Finding(WarningCode.SEVERAL_RECONSTRUCTIONS, message, names))
    return findings


def _unused_cameras(scene: Scene) -> list[Finding]:
    """Cameras none of whose images has a place, where others have one."""
    views, findings = scene.views, []
    used = views.camera[views.registered]
    for row in range(len(scene.cameras)) if len(used) else ():
        names = named(views.names, views.camera == row)
        if not names or bool((used == row).any()):
            continue
        reasons = Counter(reason for name in names if (reason := scene.failures.get(name)))
        why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
        message = (
            f"none of the photographs{scene.cameras.label(row)} could be placed ({listed(names)}{why}), so that "
            "nothing was found out about this camera: check that they show what the others do, and what is stated of it"
        )
        findings.append(Finding(WarningCode.CAMERA_NOT_PLACED, message, names))
    return findings


def _lens_is_grossly_wrong(scene: Scene) -> bool:
    """Whether focal lengths are, beyond doubt, so far off that nothing else can be judged."""
    wished = (scene.assessment.wished.get(key, (0.0, 1.0)) for key in _focal_keys(scene))
    return scene.index_ratio > 1.0 and any(abs(step) > max(SURE * sigma, GROSS) for step, sigma in wished)


def _focal_keys(scene: Scene) -> dict[str, int]:
    """Where an assessment has what the images wish of the focal lengths of all cameras alike, or of each; and a row of
    the table of cameras that it is about."""
    rows = range(len(scene.cameras))
    return {"focal": 0} | {f"focal{scene.cameras.label(row)}": row for row in rows}


def _intrinsics(scene: Scene) -> list[Finding]:
    found = [finding for key, row in _focal_keys(scene).items() for finding in _focal(scene, key, row)]
    return found + [finding for row in range(len(scene.cameras)) for finding in _uncertain(scene, row)]


def _uncertain(scene: Scene, row: int) -> list[Finding]:
    """Whether what was stated of a camera, with a sigma, is farther off than that explains."""
    cameras = scene.cameras
    stated, label = cameras.stated or cameras, cameras.label(row)
    findings = []
    for name, words, unit in UNCERTAIN:
        sigma = float(stated.sigma_of(name)[row])
        found, given = getattr(cameras, name)[row], getattr(stated, name)[row]
        off = float(found[0] / given[0] - 1.0 if name == "focal" else (found - given).abs().max())
        if sigma == 0.0 or abs(off) <= DOUBTFUL * sigma:
            continue
        shown, said = (", ".join(f"{x:.6g}" for x in value.tolist()) for value in (found, given))
        message = (
            f"{words}{label} is {shown}{unit} in the images, but {said}{unit} is stated, to {sigma:.2g}"
            f"{' of it' if name == 'focal' else unit}: check it, or state a larger sigma"
        )
        findings.append(Finding(WarningCode.INTRINSICS_CONTRADICT, message))
    return findings


def _focal(scene: Scene, key: str, row: int) -> list[Finding]:
    step, sigma = scene.assessment.wished.get(key, (0.0, 1.0))
    if abs(step) <= max(SURE * sigma, NOTABLE_FOCAL):
        return []
    width, stated = scene.cameras[row].width, float(scene.cameras.focal[row, 0])
    seen = stated * math.exp(step)
    angle, angle_seen = (math.degrees(2.0 * math.atan(0.5 * width / focal)) for focal in (stated, seen))
    message = f"the images agree best with focal lengths{key.removeprefix('focal')} "
    if sigma < VAGUE_FOCAL:
        message += f"near {seen:.4g} px (+- {100.0 * sigma:.2g} %), {angle_seen:.0f} degrees from side to side, "
    else:
        message += f"that are far {'longer' if step > 0.0 else 'shorter'}, "
    message += f"but {stated:.4g} px are stated, {angle:.0f} degrees; "
    if abs(step) > GROSS:
        message += "nothing else that was stated can be judged with these; "
    return [Finding(WarningCode.INTRINSICS_CONTRADICT, f"{message}calibrate the camera in air, or refine them")]


def _not_converged(scene: Scene) -> list[Finding]:
    after = scene.assessment.stopped_after
    if after is None:
        return []
    message = (
        f"the last adjustment stopped after {after} iterations, before it converged: raise max_iterations of its "
        "solver, or look for images or points that do not fit"
    )
    return [Finding(WarningCode.NOT_CONVERGED, message)]


def _unmodelled(scene: Scene) -> list[Finding]:
    """Water that the model knows nothing of, or that was stated, but is not there."""
    ratio = scene.assessment.water_stated
    if ratio is not None:
        message = (
            f"the images show no refraction, but an index ratio of {ratio:.4g} is stated: what they show is land, or "
            f"lies {'before' if _words(scene).is_wall else 'on'} {_words(scene).glass}, and was reconstructed as seen "
            "straight"
        )
        return [Finding(WarningCode.NO_REFRACTION_SEEN, message)]
    air, water = scene.assessment.in_air_and_water or (0.0, 0.0)
    if water >= UNDER_WATER * air:
        return []
    message = (
        f"the images show water, but were reconstructed without refraction: under a water surface their typical error "
        f"falls from {air:.2g} to {water:.2g} px; cameras, depths and shapes are wrong: use model=refractive, with the "
        "index ratio of the water"
    )
    return [Finding(WarningCode.REFRACTION_UNMODELLED, message)]


def _water(scene: Scene) -> list[Finding]:
    """What was given of the water."""
    wished, found = scene.assessment.wished, []
    step, sigma = wished.get("index_ratio", (0.0, 0.0))
    words, in_water = _words(scene), ~scene.above_water() & ~scene.outside_water()
    wet = float(in_water[scene.placed].double().mean()) if len(scene.points) else 1.0
    if wet < MOSTLY_DRY and sigma > VAGUE * (scene.index_ratio - 1.0):
        message = (
            f"the images show no refraction: they place {100.0 * (1.0 - wet):.0f} % of the points {words.above} "
            f"{words.glass}, and could not tell its index ratio, stated as {scene.index_ratio:.4g}, from another (+- "
            f"{sigma:.2g})"
        )
        found.append(Finding(WarningCode.NO_REFRACTION_SEEN, message))
    elif abs(step) > max(SURE * sigma, NOTABLE_INDEX):
        seen = max(scene.index_ratio + step, 1.0)
        if seen < AIR:
            message = f"the images show no refraction, but an index ratio of {scene.index_ratio:.4g} is stated"
            found.append(Finding(WarningCode.NO_REFRACTION_SEEN, message))
        else:
            message = (
                f"the images agree best with an index ratio near {seen:.3f} (+- {sigma:.2g}), but "
                f"{scene.index_ratio:.4g} is stated; refine it, or {words.check}"
            )
            found.append(Finding(WarningCode.INDEX_CONTRADICTS, message))
    return found


def _surface(scene: Scene) -> list[Finding]:
    """Whether the water is flat; asked where nothing else explains errors that neighbours have in common."""
    slope = scene.assessment.surface_slope
    if slope < STEEP:
        return []
    what = "moving waves" if scene.assessment.surface_moves else "waves or a bend that stand still"
    message = (
        f"errors of neighbouring points in the images go together as if {_words(scene).glass} were not flat: {what} "
        f"with a slope of {math.degrees(slope):.2g} degrees (root mean square); the standard deviations take it into "
        "account"
    )
    return [Finding(WarningCode.SURFACE_NOT_FLAT, message)]


def _outside_water(scene: Scene, stated: Capture) -> list[Finding]:
    """Points that are not seen through water, where nobody says where it ends; or that contradict who does."""
    if stated.water_extent is None:
        count = int(scene.outside_water().sum())
        if count == 0:
            return []
        level = "behind the plane of the glass" if _words(scene).is_wall else "below the water's level"
        message = (
            f"{count} points, {100.0 * count / len(scene.points):.0f} % of all, lie {level}, but are seen straight, "
            "without water before them, and were placed so; state where the water ends: water_extent in capture.json"
        )
        return [Finding(WarningCode.POINTS_OUTSIDE_WATER, message)]
    straight, through_water = scene.assessment.disputed
    least = max(FEWEST_DISPUTED, DISPUTED * len(scene.points))
    found = [f"{straight} points within it are seen straight"] if straight >= least else []
    found += [f"{through_water} points beyond it are seen through water"] if through_water >= least else []
    if not found:
        return []
    message = f"the images contradict water_extent: {' and '.join(found)}; these were placed as the images show"
    return [Finding(WarningCode.POINTS_OUTSIDE_WATER, message)]


def _words(scene: Scene) -> Wording:
    return wording(kind_of(scene))


def named(names: tuple[str, ...], which: Bool[Tensor, " k"]) -> tuple[str, ...]:
    """Those of the names that a mask picks."""
    return tuple(names[i] for i in which.nonzero()[:, 0].tolist())


def listed(names: tuple[str, ...], what: str = "images") -> str:
    """All of a few names, or the first ones and how many more of what they are."""
    return ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} and {len(names) - 3} more {what}"
