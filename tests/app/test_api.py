"""The public surface, and what importing it must not do."""

import subprocess
import sys

import pytest

import torchrefrac

PUBLIC = {
    "Capture", "DenseCloud", "DenseOptions", "FlatInterface", "Intrinsics", "LearnableCamera", "Options", "Plane",
    "Reconstruction", "RefractiveCamera", "densify", "from_kornia", "load_capture", "minimal", "patch_costs",
    "reconstruct", "remove_refraction", "solve_refrax", "to_kornia", "water_index",
}  # fmt: skip


def test_the_public_names_are_these():
    assert set(torchrefrac.__all__) == PUBLIC
    assert all(hasattr(torchrefrac, name) for name in PUBLIC)
    assert set(dir(torchrefrac)) >= PUBLIC


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'refract'"):
        torchrefrac.refract  # noqa: B018


def test_using_the_package_loads_no_heavy_extra():
    heavy = ("hydra", "omegaconf", "kornia", "tensorboard", "matplotlib", "trimesh")
    code = f"import sys; from torchrefrac import *; print([name for name in {heavy} if name in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def test_a_capture_reconstructs_without_the_command_line(sparse):
    reconstruction = torchrefrac.reconstruct(torchrefrac.load_capture(sparse / "capture"))
    assert bool(reconstruction.registered.all())
    assert float(reconstruction.reprojection_errors().median()) < 0.2
