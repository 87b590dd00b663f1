"""The typed options of what Hydra composed."""

from dataclasses import fields
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrefrac.config import AdjustOptions, DensifyOptions, Options, OutputOptions, RunOptions, build, build_scene
from torchrefrac.config.clouds import CorrectOptions, ExportOptions, TriangulateOptions
from torchrefrac.config.importing import CalibrateOptions, ImportOptions


def run_options(config: DictConfig) -> RunOptions:
    """The typed options of a composed configuration."""
    values = _plain(config)
    output = {field.name: values.pop(field.name) for field in fields(OutputOptions)}
    scene = build_scene(values.pop("scene"))
    return RunOptions(scene, build(Options, values), build(OutputOptions, output))


def adjust_options(config: DictConfig) -> AdjustOptions:
    """The typed options of a composed configuration of `torchrefrac adjust`."""
    return build(AdjustOptions, _plain(config))


def densify_options(config: DictConfig) -> DensifyOptions:
    """The typed options of a composed configuration of `torchrefrac densify`."""
    return build(DensifyOptions, _plain(config))


def import_options(config: DictConfig) -> ImportOptions:
    """The typed options of a composed configuration of `torchrefrac import`."""
    return build(ImportOptions, _plain(config))


def calibrate_options(config: DictConfig) -> CalibrateOptions:
    """The typed options of a composed configuration of `torchrefrac calibrate`."""
    return build(CalibrateOptions, _plain(config))


def correct_options(config: DictConfig) -> CorrectOptions:
    """The typed options of a composed configuration of `torchrefrac correct`."""
    return build(CorrectOptions, _plain(config))


def export_options(config: DictConfig) -> ExportOptions:
    """The typed options of a composed configuration of `torchrefrac export`."""
    return build(ExportOptions, _plain(config))


def triangulate_options(config: DictConfig) -> TriangulateOptions:
    """The typed options of a composed configuration of `torchrefrac triangulate`."""
    return build(TriangulateOptions, _plain(config))


def _plain(config: DictConfig) -> Any:
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
