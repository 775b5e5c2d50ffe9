"""Runs the command line: `python -m visioncal`."""

from visioncal.cli import main

if __name__ == "__main__":
    main()
