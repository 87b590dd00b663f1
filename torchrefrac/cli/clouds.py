"""The commands that work with other programs' results, and for them: correct a cloud, export cameras, triangulate
tracks."""

import os

import hydra
from omegaconf import DictConfig

from torchrefrac.cli.commands import may_fail
from torchrefrac.cli.composed import correct_options, export_options, triangulate_options
from torchrefrac.cli.conf import CONF
from torchrefrac.commands.correct import correct_cloud
from torchrefrac.commands.export import export_run
from torchrefrac.commands.memory import memory_lack_explained
from torchrefrac.commands.triangulate import triangulate_run
from torchrefrac.record.correction_lines import correction_lines, export_lines, triangulation_lines
from torchrefrac.record.summary import summary
from torchrefrac.record.terminal import TerminalRecorder
from torchrefrac.recorder import SilentRecorder


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="correct")
def correct(config: DictConfig) -> None:
    """`torchrefrac correct`."""
    with may_fail(), memory_lack_explained():
        options = correct_options(config)
        metrics = correct_cloud(options, SilentRecorder() if options.quiet else TerminalRecorder())
        if not options.quiet:
            print(summary([*correction_lines(metrics), f"written to {os.path.relpath(options.out)}"]))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="export")
def export(config: DictConfig) -> None:
    """`torchrefrac export`."""
    with may_fail(), memory_lack_explained():
        options = export_options(config)
        metrics = export_run(options, SilentRecorder() if options.quiet else TerminalRecorder())
        if not options.quiet:
            print(summary([*export_lines(metrics), f"written to {os.path.relpath(options.out)}"]))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="triangulate")
def triangulate(config: DictConfig) -> None:
    """`torchrefrac triangulate`."""
    with may_fail(), memory_lack_explained():
        options = triangulate_options(config)
        metrics = triangulate_run(options, SilentRecorder() if options.quiet else TerminalRecorder())
        if not options.quiet:
            print(summary([*triangulation_lines(metrics), f"written to {os.path.relpath(metrics['file'])}"]))
