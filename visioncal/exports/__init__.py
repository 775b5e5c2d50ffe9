"""Results in other people's formats: one file a family, one entry a format in the registry."""

from visioncal.exports.content import Selection
from visioncal.exports.registry import EXPORT_FORMATS, export

__all__ = ["EXPORT_FORMATS", "Selection", "export"]
