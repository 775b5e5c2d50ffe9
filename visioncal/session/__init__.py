"""Sessions: recordings of a cell, as folders of session.toml, views.csv and images.

A folder may be untrusted. Files that its tables name must be inside it, links followed. Boards and
robots that session.toml names may be outside, of which `kinds` warns.
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
