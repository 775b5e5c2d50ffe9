"""The rerun viewer: the layout of a recording, and ways to open it."""

from visioncal.viewer.layout import blueprint
from visioncal.viewer.native import review_native
from visioncal.viewer.web import review_web

__all__ = ["blueprint", "review_native", "review_web"]
