"""Safe readers of foreign files: no pickles, constructors or entities, and bounded sizes.

Every reader raises DataErrors that name the file, the line if any, the value found and the value
needed.
"""

from visioncal.core.documents.arrays import read_npy, read_npz
from visioncal.core.documents.jsons import parse_stored, read_json
from visioncal.core.documents.opencv import read_opencv
from visioncal.core.documents.tables import TextTable, is_number, read_table
from visioncal.core.documents.values import as_numbers, mapping, number, shown
from visioncal.core.documents.xmls import parse_xml, read_xml
from visioncal.core.documents.yamls import read_yaml

__all__ = [
    "TextTable",
    "as_numbers",
    "is_number",
    "mapping",
    "number",
    "parse_stored",
    "parse_xml",
    "read_json",
    "read_npy",
    "read_npz",
    "read_opencv",
    "read_table",
    "read_xml",
    "read_yaml",
    "shown",
]
