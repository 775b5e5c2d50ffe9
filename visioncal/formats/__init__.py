"""The forms in which sessions are stored: one file a format, one entry in the registry."""

from visioncal.formats.registry import FORMATS, convert

__all__ = ["FORMATS", "convert"]
