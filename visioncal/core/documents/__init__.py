"""Safe readers of foreign files: no pickles, constructors or entities, and bounded sizes.

Every reader raises DataErrors that name the file, the line if any, the value found and the value
needed. Those of OpenCV, XML and YAML are in a module of its own, which imports more.
"""

from visioncal.core.documents.jsons import parse_stored, read_json
from visioncal.core.documents.tables import TextTable, is_number, read_table
from visioncal.core.documents.values import as_numbers, mapping, number, shown

__all__ = [
    "TextTable",
    "as_numbers",
    "is_number",
    "mapping",
    "number",
    "parse_stored",
    "read_json",
    "read_table",
    "shown",
]
