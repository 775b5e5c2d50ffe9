"""The command line: one thin file a command."""

from visioncal.cli.app import main
