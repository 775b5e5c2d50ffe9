"""Programs of robots whose targets `correct` replaces: one file and one entry a dialect."""

from visioncal.interchange.programs.krl import KRL
from visioncal.interchange.programs.program import CorrectedProgram as CorrectedProgram
from visioncal.interchange.programs.program import Dialect as Dialect
from visioncal.interchange.programs.program import correct_program as correct_program
from visioncal.interchange.programs.rapid import RAPID
from visioncal.interchange.programs.urscript import URSCRIPT

DIALECTS: tuple[Dialect, ...] = (KRL, RAPID, URSCRIPT)


def dialect_of(suffix: str) -> Dialect | None:
    """The dialect of a file by its suffix; None for no program."""
    return next((each for each in DIALECTS if suffix.lower() in each.suffixes), None)
