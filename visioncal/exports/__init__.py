"""Results in other people's formats: one file a family, one entry a format in the registry."""

from visioncal.exports.content import Selection
from visioncal.exports.registry import FORMATS, export

__all__ = ["FORMATS", "Selection", "export"]
