"""Results in foreign formats: one file a family, one registry entry a format."""

from visioncal.interchange.exports.registry import EXPORT_FORMATS, Document, document, export
from visioncal.interchange.selection import Load, Selection
