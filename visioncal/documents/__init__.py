"""Files of others, read as data: no pickles, no constructors, no entities, and bounded sizes.

Every reader raises DataError that names the file, the line where there is one, what was seen and
what is needed.
"""

from visioncal.documents.arrays import read_npy, read_npz
from visioncal.documents.jsons import read_json
from visioncal.documents.opencv import read_opencv
from visioncal.documents.stored import Kinds, parse_stored
from visioncal.documents.tables import TextTable, is_number, read_table
from visioncal.documents.values import as_numbers, mapping, number, shown
from visioncal.documents.xmls import Element, read_xml
from visioncal.documents.yamls import read_yaml

__all__ = [
    "Element",
    "Kinds",
    "TextTable",
    "as_numbers",
    "is_number",
    "mapping",
    "number",
    "parse_stored",
    "read_json",
    "read_npy",
    "read_npz",
    "read_opencv",
    "read_table",
    "read_xml",
    "read_yaml",
    "shown",
]
