"""Sessions: what was recorded of a cell, as a folder of session.toml, views.csv and images.

A folder may come from a stranger. What its tables name lies inside it, wherever links lead; what
session.toml names itself, boards and robots, may lie outside, which `kinds` says to the user.
"""

from visioncal.session.document import Declaration
from visioncal.session.frames import frame_name
from visioncal.session.images import FolderImages, ImageStore, MemoryImages
from visioncal.session.observations import Observation
from visioncal.session.session import Session
from visioncal.session.streams import FOLDER as STREAMS
from visioncal.session.streams import Stream, check_stream, save_stream, too_far_apart
from visioncal.session.table import View
from visioncal.vision.targets import target_document

__all__ = [
    "STREAMS",
    "Declaration",
    "FolderImages",
    "ImageStore",
    "MemoryImages",
    "Observation",
    "Session",
    "Stream",
    "View",
    "check_stream",
    "frame_name",
    "save_stream",
    "target_document",
    "too_far_apart",
]
