"""`visioncal align`, another name for `calibrate`."""

from visioncal.cli.calibrate import calibrate_command

align_command = calibrate_command
