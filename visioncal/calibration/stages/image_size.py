"""Size of a camera's images, and the lens of images that were resized or turned."""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.finding_kinds import OTHER_SIZE
from visioncal.core.number_format import some_of
from visioncal.core.types import Camera, FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.kinds import name_of

Size = tuple[int, int]
# Largest relative difference of the scales of both sides for resized images; others were cropped.
_SAME_SHAPE = 0.02
# Least scale of resized images, the largest denominator of the usual ratios, and the relative
# accuracy of focal lengths by images.
_LEAST_SCALE, _LARGEST_DENOMINATOR, _SAME_SCALE = 1.1, 8, 0.02


def stated_size(session: Session, views: Sequence[View]) -> Size | None:
    """Stated (width, height) of the images of some views [px]; None without one."""
    names = {name_of(session.declaration, "camera", view) for view in views}
    sizes = {session.cameras[name].size for name in names & session.cameras.keys()} - {None}
    return sizes.pop() if len(sizes) == 1 else None


def common_size(session: Session, views: Sequence[View], sizes: Mapping[int, Size]) -> Size:
    """The stated (width, height) of images [px], else the most common one.

    Args:
        session: The session.
        views: The views with images, of one camera.
        sizes: (width, height) of each image that can be read, by view [px]; one or more.

    Raises:
        DataError: Half of the images or more have another size.
    """
    found, stated = [*sizes.values()], stated_size(session, views)
    size = stated or max(set(found), key=found.count)
    line_of = {view.number: line for line, view in enumerate(session.views, start=2)}
    culprits = [
        f"views.csv line {line_of[view.number]}, column image: {view.image} is {width} x {height} "
        "px"
        for view in views
        for width, height in [sizes.get(view.number, size)]
        if (width, height) != size
    ]
    if 2 * len(culprits) < len(found):
        return size
    if len(set(found)) == 1:
        words, step = _other_size(session, views[0], found[0])
        message = (
            f"All {len(found)} images are {found[0][0]} x {found[0][1]} px, but session.toml has "
            f"resolution = [{size[0]}, {size[1]}]{words and f': {words}'}."
        )
    else:
        source = "the camera's resolution is" if stated else "most other images are"
        message = (
            f"{culprits[0]}, but {source} {size[0]} x {size[1]} px ({len(culprits)} of "
            f"{len(found)} images)."
        )
        step = "Correct [camera] resolution in session.toml, or take out these views."
    raise DataError(message, culprits=culprits, next_step=step)


def _other_size(session: Session, view: View, size: Size) -> tuple[str, str]:
    """What all images of another size than the camera's are, and what to type."""
    mine = name_of(session.declaration, "camera", view)
    stated = session.cameras[mine].stated
    write = f"write resolution = [{size[0]}, {size[1]}]"
    other = next((name for name, at in session.cameras.items() if at.size == size), None)
    if other is not None:
        return (
            f"that is the size of camera {other}'s",
            f"Exchange {mine} and {other} in the column camera of views.csv; or, where they are "
            f"not exchanged, {write} of {mine} in session.toml.",
        )
    write = f"In session.toml, {write}"
    if stated is None:
        return "", f"{write}."
    scales = size[0] / stated.resolution[0], size[1] / stated.resolution[1]
    if abs(scales[0] / scales[1] - 1.0) < _SAME_SHAPE:
        return "", f"{write} and {_entry(scaled_matrix(stated.matrix, scales[0]))}."
    turned = "the images were turned by 90 degrees after the matrix was made"
    return (
        turned if size == stated.resolution[::-1] else "",
        f"{write}, and delete matrix and distortion: they are of other images.",
    )


def other_size_findings(
    session: Session, resolution: Size, others: Mapping[int, Size]
) -> Iterator[Finding]:
    """Finding about images of another size than the camera's, by view [px]."""
    if not others:
        return
    wide, high = resolution
    names = {view.number: view.image for view in session.views}
    shown = [f"{names[view]} ({w} x {h} px)" for view, (w, h) in others.items()]
    is_turned = {*others.values()} == {(high, wide)}
    mend = "Turn them back" if is_turned else "Take them again at the camera's full size"
    views = tuple(others)
    yield Finding(
        OTHER_SIZE,
        f"{len(views)} of the images {'turned by 90 degrees' if is_turned else 'of another size'}, "
        f"and not used: {some_of(shown)}; the camera's are {wide} x {high} px.",
        Remedy(f"{mend}; or in views.csv, delete the rows of view {', '.join(map(str, views))}."),
        views,
        until_mm=0.0,
    )


def other_images(stated: Camera, matrix: FloatArray) -> tuple[str, str]:
    """Explains a stated matrix that is for images of another size.

    Args:
        stated: The stated lens, with the size of the images.
        matrix: (4,) estimated fx, fy, cx, cy of these images [px].

    Returns:
        What is wrong, and what to write; both empty where that does not explain the difference.
    """
    scale = float(np.sqrt(np.prod(matrix[:2] / stated.matrix[:2])))
    if max(scale, 1.0 / scale) < _LEAST_SCALE:
        return "", ""
    ratio = float(Fraction(scale).limit_denominator(_LARGEST_DENOMINATOR))
    scale = ratio if abs(ratio / scale - 1.0) < _SAME_SCALE else scale
    scaled, (width, height) = scaled_matrix(stated.matrix, scale), stated.resolution
    limits = np.repeat([_SAME_SCALE * scale * stated.matrix[0], _SAME_SHAPE * width], 2)
    if np.any(np.abs(scaled - matrix) > limits):
        return "", ""
    return (
        f"The stated matrix is for images of {width / scale:.0f} x {height / scale:.0f} px, and "
        f"these are {width} x {height} px: fx is {stated.matrix[0]:.1f} px there, and "
        f"{matrix[0]:.1f} px by these images ({scale:.3g} times as large).",
        f"In session.toml, write {_entry(scaled)}.",
    )


def scaled_matrix(matrix: FloatArray, scale: float) -> FloatArray:
    """Camera matrix fx, fy, cx, cy of resized images; pixel centres are at integers."""
    return np.array([*(scale * matrix[:2]), *(scale * (matrix[2:] + 0.5) - 0.5)])


def _entry(matrix: FloatArray) -> str:
    return f"matrix = [{', '.join(f'{value:.2f}' for value in matrix.tolist())}]"
