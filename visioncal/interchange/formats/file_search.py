"""Finds files: in natural order, by the number in their names, and images by their rows."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import is_inside, natural
from visioncal.interchange.formats.reading import named_by
from visioncal.session.images import IMAGE_ENDINGS


def number_in(name: str) -> int | None:
    """Last number in a file's name without its ending; None where there is none."""
    digits = re.findall(r"[0-9]+", Path(name).stem)
    return int(digits[-1]) if digits and len(digits[-1]) < 19 else None


def series_name(path: Path) -> str:
    """A file's name without its last number: equal for files of one series."""
    return re.sub(r"[0-9]+([^0-9]*)$", r"\1", path.stem).strip("_-. ") + path.suffix.lower()


def files_in(folder: Path) -> tuple[Path, ...]:
    """Files of a folder in natural order; empty where it cannot be listed.

    Links that lead out of it are left out.
    """
    try:
        files = [path for path in folder.iterdir() if path.is_file()]
    except OSError:
        return ()
    own = (file for file in files if not file.is_symlink() or is_inside(file, folder))
    return tuple(sorted(own, key=natural))


def _images_in(folder: Path) -> tuple[Path, ...]:
    """Images of a folder in natural order."""
    if images := tuple(path for path in files_in(folder) if is_image_name(path.name)):
        return images
    raise DataError(
        f"{folder} has no images (png, jpg, tif, bmp, webp), or is no folder.",
        culprits=[str(folder)],
        next_step="Name the folder of the images with --images.",
    )


def head(path: Path) -> str:
    """The beginning of a text file; empty where it is not text."""
    try:
        with path.open("rb") as file:
            # Length that suffices to recognise a text file.
            data = file.read(16_384)
    except (OSError, ValueError):
        return ""
    return "" if b"\0" in data else data.decode("utf-8", "ignore")


def images_named(
    names: Sequence[str | None], base: Path, folder: Path | None
) -> tuple[Path | None, ...]:
    """(n,) paths of the images that rows name; of a missing image the one that the source states.

    Names are relative to `base`, or to the folder `images` in it; in `folder`, if given, images are
    matched by their names, else by the numbers in these. Raises DataError.
    """
    images = () if folder is None else _images_in(folder)
    by_name = {item.stem: item for item in images} | {item.name: item for item in images}
    numbers = [number_in(name) for name in names if name]
    is_unique = len(set(numbers)) == len(numbers) and None not in numbers
    by_number = _unique_numbers(images) if is_unique else {}
    paths: list[Path | None] = []
    for name in names:
        path: Path | None = None
        if name and folder is not None:
            plain = name.replace("\\", "/").rsplit("/", 1)[-1]
            path = by_name.get(plain) or by_number.get(number_in(plain))
            path = path or path_inside(folder, plain)
        elif name:
            path = path_inside(base, name)
            inner = base / "images" / path.name
            if not path.exists() and is_inside(inner, base) and inner.exists():
                path = inner
        if path is not None and not is_image_name(path.name):
            raise DataError(
                f"{base}: an image is named {str(name)[:80]!r}; a png, jpg, tif, bmp or "
                "webp is needed.",
                culprits=[str(name)[:80]],
                next_step="Correct it, or name the column of the images with --image-column.",
            )
        paths.append(path)
    return tuple(paths)


def is_image_name(name: str) -> bool:
    """Whether a name has an image's ending."""
    return name.lower().endswith(IMAGE_ENDINGS)


def images_beside(
    folder: Path, views: Sequence[int], labels: Sequence[str]
) -> tuple[tuple[Path | None, ...], tuple[str, ...]]:
    """Pairs rows with the images of a folder, and notes assumptions; raises DataError.

    By the rows' numbers in the source's names (`views`), where there are some and the images have
    them, too; otherwise both are paired in natural order, and their counts must agree.
    """
    images = _images_in(folder)
    of_views = [image for image in images if number_in(image.name) in set(views)]
    by_number = _unique_numbers(of_views)
    if 0 < len(by_number) == len(of_views):
        return tuple(by_number.get(view) for view in views), ()
    first, last = images[0].name, images[-1].name
    if len(images) != len(labels):
        raise DataError(
            f"{folder} has {len(images)} images ({first} ... {last}), but there are {len(labels)} "
            f"poses ({labels[0]} ... {labels[-1]}); one image a pose is needed.",
            culprits=[str(folder)],
            next_step=f"Name each row's image with --image-{named_by(labels[0]).rstrip('s')}, or "
            "remove what is over. Where that is not known, remove the last, and doctor "
            "says from where on rows and images are shifted.",
        )
    return images, (
        f"Rows and images are paired in order, {labels[0]} with {first}, {labels[-1]} with {last}; "
        "--image-column names a column that names each row's image.",
    )


def _unique_numbers(paths: Sequence[Path]) -> dict[int | None, Path]:
    """Files by the number in their names, where only one has it."""
    counts = Counter(number_in(path.name) for path in paths)
    by_number = {number_in(path.name): path for path in paths}
    return {n: path for n, path in by_number.items() if n is not None and counts[n] == 1}


def path_inside(base: Path, name: str) -> Path:
    """Path of a file that a document names, relative to the document's folder; raises DataError."""
    path = base / name.replace("\\", "/")
    if not is_inside(path, base):
        raise DataError(
            f"{base}: the path {name[:80]!r} is too long or leaves the folder; a file inside it is "
            "needed.",
            culprits=[name[:80]],
            next_step="Name the folder of the images with --images.",
        )
    return path
