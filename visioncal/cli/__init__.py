"""The command line: one thin file a command."""

import sys

# Ctrl-C while the libraries are imported, which takes a part of a second.
try:
    from visioncal.cli.app import main
except KeyboardInterrupt:
    sys.exit(128 + 2)
