"""The rerun viewer: layouts of recordings, and ways to open them."""

from visioncal.present.viewer.layout import blueprint
from visioncal.present.viewer.native import review_native, review_web
