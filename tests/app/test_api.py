"""The public surface, and what importing it must not do."""

import inspect
import subprocess
import sys

import pytest

import torchrefrac
from tests.files.metadata.made_photographs import write_photograph

PUBLIC = {
    "BundleBatch", "BundleOptions", "Cameras", "Capture", "DenseCloud", "DenseOptions", "ExecutorOptions",
    "FlatInterface", "ImportOptions", "Interfaces",
    "Intrinsics", "LearnableCamera", "Observations", "Options", "Plane", "Rays", "ReadjustOptions", "RefractiveCamera",
    "RefractiveRays", "Rigid",
    "Scene", "SfmOptions", "Survey", "TorchrefracError", "Truth", "Views", "Work", "Workers", "adjust",
    "adjust_differentiably", "adjust_each", "bundle",
    "densify", "embedded_scene", "evaluate", "from_kornia", "import_photographs", "load_cameras", "load_capture",
    "load_truth", "made_scene", "minimal", "patch_costs", "ransac", "read_scene", "read_survey", "reconstruct",
    "refinement", "remove_refraction", "sfm", "solve_refrax", "to_kornia", "triangulate_tracks",
    "water_index",
}  # fmt: skip
HEAVY = ("hydra", "omegaconf", "kornia", "tensorboard", "matplotlib", "trimesh")


def _loaded(code, *modules):
    """Which of the modules are loaded in a new process once it has run the code."""
    code = f"import sys; {code}; print([name for name in {modules} if name in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ended.stdout.strip()


def test_the_public_names_are_these():
    assert len(torchrefrac.__all__) == len(PUBLIC)
    assert set(torchrefrac.__all__) == PUBLIC
    assert set(dir(torchrefrac)) >= PUBLIC


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_is_there_and_documented(name):
    value = getattr(torchrefrac, name)

    said = vars(value).get("__doc__") if isinstance(value, type) else inspect.getdoc(value)
    assert said
    assert not said.startswith(f"{name}(")  # which is what a dataclass says of itself where nobody does


def test_a_name_that_a_room_has_too_stays_the_function():
    code = "import torchrefrac, torchrefrac.evaluate.consistency; torchrefrac.reconstruct; print(torchrefrac.evaluate)"

    assert _loaded(code).startswith("<function evaluate")


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'refract'"):
        torchrefrac.refract  # noqa: B018


def test_importing_the_package_loads_nothing_and_using_it_no_heavy_extra():
    assert _loaded("import torchrefrac", "torch", "numpy", "cv2", *HEAVY) == "[]"
    assert _loaded("from torchrefrac import *", *HEAVY) == "[]"


def test_files_of_runs_and_sweeps_and_the_base_of_errors_do_without_torch():
    code = "import torchrefrac; import torchrefrac.files.run, torchrefrac.sweeps.folder; torchrefrac.TorchrefracError"

    assert _loaded(code, "torch", "numpy", *HEAVY) == "[]"


def test_photographs_become_a_capture_without_the_command_line(tmp_path):
    for i in range(2):
        write_photograph(tmp_path / "DCIM" / f"{i}.jpg", seed=i)

    options = torchrefrac.ImportOptions(photos=str(tmp_path / "DCIM"), out=str(tmp_path / "river"), focal_px=80.0)
    report = torchrefrac.import_photographs(options)

    assert report["used"] == 2
    assert torchrefrac.load_capture(tmp_path / "river").cameras.focal.tolist() == [[80.0, 80.0]]


def test_a_capture_reconstructs_without_the_command_line(sparse):
    scene = torchrefrac.reconstruct(torchrefrac.load_capture(sparse / "capture"))
    assert bool(scene.views.registered.all())
    assert float(scene.errors().median()) < 0.2
