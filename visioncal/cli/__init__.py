"""The command line: thin glue, one file a command."""

from visioncal.cli.app import main

__all__ = ["main"]
