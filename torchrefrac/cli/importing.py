"""The commands that come before a reconstruction: import photographs, calibrate a camera."""

import os

import hydra
from omegaconf import DictConfig

from torchrefrac.cli.commands import may_fail
from torchrefrac.cli.composed import calibrate_options, import_options
from torchrefrac.cli.conf import CONF
from torchrefrac.commands.calibrate import calibrate as calibrate_camera
from torchrefrac.commands.calibrate import calibration_lines
from torchrefrac.commands.calibrate_capture import calibrate_capture, capture_lines
from torchrefrac.commands.import_photographs import import_photographs
from torchrefrac.record.import_lines import import_lines
from torchrefrac.record.summary import summary
from torchrefrac.record.terminal import TerminalRecorder
from torchrefrac.recorder import SilentRecorder


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="import")
def import_(config: DictConfig) -> None:
    """`torchrefrac import`."""
    with may_fail():
        options = import_options(config)
        report = import_photographs(options, SilentRecorder() if options.quiet else TerminalRecorder())
        if not options.quiet:
            print("\n".join(import_lines(report)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="calibrate")
def calibrate(config: DictConfig) -> None:
    """`torchrefrac calibrate`."""
    with may_fail():
        options = calibrate_options(config)
        recorder = SilentRecorder() if options.quiet else TerminalRecorder()
        if options.capture is None:
            lines = calibration_lines(calibrate_camera(options, recorder), options.out)
        else:
            lines = capture_lines(calibrate_capture(options, recorder))
            lines.append(f"written to {os.path.relpath(options.out)}")
        if not options.quiet:
            print(summary(lines))
