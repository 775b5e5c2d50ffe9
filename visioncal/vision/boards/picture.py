"""Any flat print as a target: a poster, a label, a circuit board, by its picture.

Features give the start (Lowe 2004, SIFT; Barath et al. 2020, MAGSAC++), and the picture is then
registered to all pixels. It leaves the places of some hundred patches, each by its own
pixels, which serve as a board's corners do.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import cv2
import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.imaging import decode_image, resized
from visioncal.vision.boards.kind import (
    BoardKind,
    DetectedCorners,
    NotFound,
    file_beside,
    sigma_of,
    size_of,
)
from visioncal.vision.hard_matches import Features, hard_matches, is_installed

if TYPE_CHECKING:
    from visioncal.vision.register.image_model import Print

# Number of patches, features of an image, and features that agree where the picture is seen: twice
# those of a homography.
_PATCHES, _FEATURES, _FEWEST = 120, 2500, 8
# Long sides of the copies of images that are searched, the quicker one first, and pixels of a print
# that are registered, within a factor of 2.25.
_SEARCHED_PX, _REGISTERED = (500, 1000), 1.6e5
# Least spread of a picture's grey levels.
_PLAIN = 4.0


@dataclass(frozen=True)
class PictureTarget(Target):
    """A picture: its `square_m` is the printed width, columns and rows those of its patches."""

    image: str = ""  # Its file, in base64.
    # Folder of LightGlue's weights, by which hard views are matched.
    weights_in: Path | None = field(default=None, compare=False)


class Picture(BoardKind):
    """A picture. Its origin is its upper left corner; its corners are the middles of patches."""

    name: ClassVar[str] = "picture"
    noun = "picture"
    keys = "width_m square_sigma_m image"
    size_key = "width_m"
    options = "--width-mm --name"
    side, sides, unit = "width of the print", "a width", "width"
    is_seen_in_part = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads width_m, square_sigma_m and image, which `loaded` has read from its file."""
        width_m = table.number("width_m", positive=True)
        # A poster may be wider than any square.
        width_m = width_m if width_m <= 3.0 else size_of(table, "width_m")
        image = table.text("image")
        grey = _grey(image)
        if isinstance(grey, str):
            raise table.refuse("image", image[:40], f"the path of a picture (it is {grey})")
        aspect = grey.shape[1] / grey.shape[0]
        columns = min(max(round(float(np.sqrt(_PATCHES * aspect))), 4), 30)
        rows = min(max(round(_PATCHES / columns), 4), 30)
        return PictureTarget(
            name, self.name, columns, rows, width_m, sigma_of(table, width_m), image=image
        )

    def document(self, target: Target) -> dict[str, Any]:
        """The target as the content of a `.toml`, with its picture."""
        picture = cast("PictureTarget", target)
        sizes = {"width_m": target.square_m, "square_sigma_m": target.square_sigma_m}
        return sizes | {"image": picture.image}

    def loaded(self, document: dict[str, Any], folder: Path) -> dict[str, Any]:
        """The content of its `.toml` with its picture's file, reduced where it is large."""
        name = document.get("image")
        if not isinstance(name, str):
            return document
        path = file_beside(folder, "image", name, "picture")
        return document | {"image": kept_picture(path)}

    def stored(
        self, document: Mapping[str, Any], stem: str
    ) -> tuple[Mapping[str, Any], dict[str, str | bytes]]:
        """The content of its `.toml`, and its picture `STEM.picture.jpg`."""
        name = f"{stem}.picture.jpg"
        return {**document, "image": name}, {name: base64.b64decode(document["image"])}

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) middles of the picture's patches [m], row by row."""
        _, (width, height) = self.extent_m(target)
        x = (np.arange(target.columns) + 0.5) * width / target.columns
        y = (np.arange(target.rows) + 0.5) * height / target.rows
        return np.pad(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), ((0, 0), (0, 1)))

    def words(self, target: Target, size: str) -> str:
        """The picture in a few words."""
        del size
        return f"picture {target.name}"

    def picture(self, target: Target) -> Image | None:
        """(h, w) grey levels of the picture."""
        grey = _grey(cast("PictureTarget", target).image)
        return None if isinstance(grey, str) else grey

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print [m]."""
        grey = self.picture(target)
        shape = (1, 1) if grey is None else grey.shape
        return np.zeros(2), target.square_m * np.array([1.0, shape[0] / shape[1]])

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        width, height = (1e3 * self.extent_m(target)[1]).tolist()
        return (
            f"picture, {width:g} x {height:.4g} mm",
            "the picture's upper left corner",
            "Measure the picture's width and write it into width_m, in metres.",
        )

    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Places of its patches in a (h, w) grey image, or why it is not found."""
        picture_target = cast("PictureTarget", target)
        picture = _known(picture_target)
        if picture.unfit:
            return NotFound(f"the picture {picture.unfit}")
        reason = ""
        for longest_px in _SEARCHED_PX:
            start = picture.matched(image, picture_target.weights_in, longest_px)
            found = start if isinstance(start, str) else self._registered(image, target, start)
            if isinstance(found, DetectedCorners):
                return found
            reason = found
        turned = picture.matched(np.ascontiguousarray(image[:, ::-1]))
        return NotFound(reason if isinstance(turned, str) else "the picture is seen mirrored")

    def _registered(
        self, image: Image, target: Target, start: tuple[FloatArray, FloatArray, FloatArray]
    ) -> DetectedCorners | str:
        from visioncal.vision.patches import places_of, started, usual_lens, usual_sigma
        from visioncal.vision.register.fit import register
        from visioncal.vision.register.image_model import Seen

        print_ = _known(cast("PictureTarget", target)).print_
        ends = cv2.perspectiveTransform(print_.outline_m[None, :, :2], start[0])
        area = cv2.contourArea(ends.astype(np.float32))
        lens, pose = started(*start, usual_lens(image))
        factor = max(1, round(float(np.sqrt(area / _REGISTERED))))
        factors, sigma, found = (2 * factor, factor), usual_sigma(lens), None
        for rough in (False, True):
            # Of wide blurs the shape counts.
            if found is None or found.seen.gauss_px > 1.5 * factor:
                found = register(
                    image, print_, lens, Seen(pose), lens_sigma=sigma, factors=factors, rough=rough
                )
        # Least share of the image's variance that a picture explains, and blur from which on its
        # shape is sought [px].
        if found is None or found.explained < 0.8:
            return "the picture is another one: features agree, and all pixels do not"
        half_m = 0.5 * target.square_m / target.columns
        ids, px, sigma_px = places_of(found, self.corners(target), half_m)
        if len(ids) < self.fewest:
            return f"too little of the picture is free: {len(ids)} patches of it"
        weights = float(np.median(sigma_px)) / sigma_px
        # Patches that tell little of their place err by the model, which no weight says.
        clear = weights**2 > 0.2
        return DetectedCorners(ids[clear], px[clear], weights[clear], blur_px=found.seen.blur_px)


def with_weights(target: Target, folder: Path) -> Target:
    """A target whose hard views are matched by the weights in a folder, too, if it is a picture."""
    return replace(target, weights_in=folder) if isinstance(target, PictureTarget) else target


def kept_picture(path: Path) -> str:
    """A picture's file in base64: as it is, or reduced, grey and compressed where it is large.

    Raises:
        DataError: There is no such file, or it is no image.
    """
    data = read_bytes(path)
    grey = decode_image(data)
    if isinstance(grey, str):
        raise DataError(f"{path} is {grey}.", culprits=[str(path)])
    # Longest side of a picture that is kept [px]: a camera resolves no more of a print in its view.
    shrink = 1600 / max(grey.shape)
    if shrink < 1.0:
        grey = resized(grey, shrink)
    elif data.startswith(b"\xff\xd8\xff"):
        return base64.b64encode(data).decode()
    _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return base64.b64encode(encoded.tobytes()).decode()


@lru_cache(maxsize=16)
def _grey(image: str) -> Image | str:
    """(h, w) grey levels of a file in base64, or why there are none. Read only."""
    try:
        return decode_image(base64.b64decode(image, validate=True))
    except ValueError:
        return "no picture"


@dataclass(frozen=True, eq=False)
class _Known:
    """A picture with its features."""

    print_: "Print"
    features: Features
    unfit: str  # Why no pose is known by it; empty where it is.

    def matched(
        self, image: Image, weights_in: Path | None = None, longest_px: int = _SEARCHED_PX[-1]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | str:
        """(3, 3) from the print [m] to an image, (n, 3) features and (n, 2) pixels; or why not.

        The image is searched in a copy of `longest_px`; by kornia, too, in the largest alone.
        """
        seen = features_of(image, longest_px=longest_px)
        if len(seen.px) < _FEWEST:
            return "the picture is not seen: the image is plain"
        # From the image's: a picture has more, and several of them would share one of few.
        pairs = cv2.BFMatcher().knnMatch(seen.described, self.features.described, k=2)
        good = [
            (one.queryIdx, one.trainIdx) for one, two in pairs if one.distance < 0.8 * two.distance
        ]
        tolerance_px = 3.0 * max(max(seen.shape) / longest_px, 1.0)
        found = self._agreeing(seen, np.array(good).reshape(-1, 2), tolerance_px)
        if found is None and longest_px == _SEARCHED_PX[-1] and is_installed():
            hard = hard_matches(seen, self.features, weights_in)
            tries = (self._agreeing(seen, match, tolerance_px) for match in hard)
            found = next((one for one in tries if one is not None), None)
        if found is None:
            return f"the picture is not seen: {len(good)} features are like it, and do not agree"
        return found

    def _agreeing(
        self, seen: Features, pairs: IntArray, tolerance_px: float
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """The answer of `matched`, by (m, 2) indices of features; None where they do not agree."""
        if len(pairs) < _FEWEST:
            return None
        places = self.print_.texel_m * (self.features.px[pairs[:, 1]] + 0.5)
        px = seen.px[pairs[:, 0]]
        flat, inside = cv2.findHomography(places, px, cv2.USAC_MAGSAC, tolerance_px)
        if flat is None or inside.sum() < max(_FEWEST, 0.15 * len(pairs)):
            return None
        outline = self.print_.outline_m[None, :, :2].astype(np.float32)
        ends = cv2.perspectiveTransform(outline, flat)
        # Seen from its front: the outline keeps its sense.
        is_front = cv2.contourArea(ends, True) * cv2.contourArea(outline, True) > 0.0
        if not (cv2.isContourConvex(ends) and is_front):
            return None
        off = cv2.perspectiveTransform(places[None], flat)[0] - px
        # So far a lens bends what is straight.
        near = np.linalg.norm(off, axis=1) < 0.03 * max(seen.shape)
        return np.asarray(flat, float), np.pad(places, ((0, 0), (0, 1)))[near], px[near]


def features_of(grey: Image, most: int = _FEATURES, longest_px: int = _SEARCHED_PX[-1]) -> Features:
    """The clearest features of a (h, w) image, found in a copy that is no longer than stated."""
    shrink = min(1.0, longest_px / max(grey.shape))
    points, described = cv2.SIFT.create(nfeatures=most).detectAndCompute(
        resized(grey, shrink), None
    )
    described = np.zeros((0, 128)) if described is None else described
    root = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9))
    circles = np.array([(*one.pt, one.size, one.angle) for one in points]).reshape(-1, 4)
    px = (circles[:, :2] + 0.5) / shrink - 0.5
    diameters, angles = circles[:, 2] / shrink, circles[:, 3]
    return Features(px, diameters, angles, np.asarray(root, np.float32), grey.shape)


@lru_cache(maxsize=8)
def _known(target: PictureTarget) -> _Known:
    from visioncal.vision.register.image_model import Print

    grey = Picture().picture(target)
    assert grey is not None
    # The clearest features of the picture itself are finer than an image shows.
    features = features_of(grey, 20_000)
    return _Known(Print.of_picture(grey, target.square_m), features, unfit(grey, len(features.px)))


def unfit(grey: Image, features: int | None = None) -> str:
    """Why no pose is known by a picture (h, w), as a part of a sentence; empty where one is."""
    if grey.std() < _PLAIN or (len(features_of(grey).px) if features is None else features) < 60:
        return "is too plain: it has too few features to be found by"
    small = resized(grey, 48 / max(grey.shape)).astype(float)
    if _alike(small, small[::-1, ::-1]):
        return "looks the same turned by a half: its pose would have two answers"
    square = np.asarray(cv2.resize(small, (48, 48)), float)
    if 0.9 < grey.shape[0] / grey.shape[1] < 1.1 and _alike(square, np.rot90(square)):
        return "looks the same turned by a quarter: its pose would have four answers"
    rows, columns = small.shape
    for down in range(rows // 2):
        for along in range(-columns // 2, columns // 2 + 1):
            far = down > rows // 8 or abs(along) > columns // 8
            a = small[down:, max(along, 0) : columns + min(along, 0)]
            b = small[: rows - down, max(-along, 0) : columns - max(along, 0)]
            if far and _alike(a, b):
                return "repeats itself: shifted, it looks the same"
    return ""


def _alike(a: FloatArray, b: FloatArray) -> bool:
    if min(a.std(), b.std()) < 0.1 * _PLAIN:
        return False
    # From this correlation on a picture, turned or shifted, looks the same as itself.
    return bool(np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.9)
