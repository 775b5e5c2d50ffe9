"""Finds files: those of a source in groups of one kind, and the image of each row."""

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, is_inside, natural, read_bytes
from visioncal.core.types import IntArray
from visioncal.interchange.formats.documents import SOURCES
from visioncal.interchange.formats.keys import Keys, is_image_name
from visioncal.interchange.formats.reading import ENDINGS
from visioncal.session.images import CLOUD_ENDINGS, IMAGE_ENDINGS

# Endings of texts with numbers that are none of a recording.
_NO_DATA = (
    *(".py", ".md", ".html", ".sh", ".c", ".cc", ".cpp", ".h", ".ipynb", ".urdf", ".xacro", ".svg"),
    *(".m", ".sln", "cmakelists.txt", "requirements.txt", ".ply", ".pcd"),
)
# Folders below a source that are looked through, and the most files in all; a source of more files
# than a recording in folders has, such as a disk, is looked through less deep.
_DEPTH, _FEW_FILES, _LESS_DEEP, _MOST_FILES = 8, 5_000, 3, 100_000
# Bytes of a file that is too small for a cloud or a depth picture.
_LEAST_OF_CLOUD = 1_000
# Words of pictures that a program drew: they are no camera's where there are others.
DRAWN = re.compile(
    r"result|overlay|detect|corner|annot|draw|debug|visual|vis(?![a-z])|axes|axis|mask|plot|"
    r"preview|thumb|reproj|heat|undist|rectif",
    re.IGNORECASE,
)


# Files of numbers that are not read, and how to write them.
_PICKLE = "a pickle, which runs code when it is opened: write its arrays as .npz or .json"
_WORKBOOK = "a workbook: save its sheet with the poses as .csv"
_SHUT = dict.fromkeys((".pkl", ".pickle", ".p"), _PICKLE) | dict.fromkeys(
    (".xlsx", ".xls"), _WORKBOOK
)


def shut(label: str) -> str:
    """A kind of files of numbers that is not read, and how to write them; empty of others."""
    return next((_SHUT[end] for end in _SHUT if label.lower().endswith(end)), "")


@dataclass(frozen=True)
class ImageKind:
    """Content of an image file."""

    size: tuple[int, int]  # (width, height) [px].
    words: str  # `8-bit colour`.
    is_depth: bool  # Whether its numbers are distances: one channel of more than eight bits.


def image_kind(path: Path) -> ImageKind | None:
    """The kind of an image file; None where it cannot be decoded."""
    try:
        data = np.frombuffer(read_bytes(path, MOST_IMAGE_BYTES), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except (DataError, cv2.error):
        return None
    if image is None:
        return None
    bits, is_grey = 8 * image.itemsize, image.ndim == 2
    words = f"{bits}-bit {'grey' if is_grey else 'colour'}"
    return ImageKind(image.shape[1::-1], words, is_grey and bits > 8)


@dataclass(frozen=True)
class FileGroup:
    """Files of a source whose paths differ in numbers alone, files of one kind, or one file."""

    label: str  # Their path in the source: `images/img_#.png`.
    files: tuple[Path, ...]  # In natural order.
    numbers: tuple[int, ...] = ()  # The number by which they differ; empty without one.
    is_source: bool = False  # Whether it is the source itself, which may be a program.

    @property
    def name(self) -> str:
        """Name of the files without numbers, else of their folder."""
        parts = reversed(Path(self.label).with_suffix("").parts)
        return next(filter(None, (part.replace("#", "").strip("_-. ") for part in parts)), "")

    @property
    def is_images(self) -> bool:
        """Whether the files are images by their names."""
        return is_image_name(self.label)

    @cached_property
    def is_data(self) -> bool:
        """Whether they have the ending of numbers, or an unknown one and numbers in them."""
        words = self.label.lower()
        if words.endswith(_NO_DATA):
            return self.is_source and words.endswith((*SOURCES, ".m"))
        if words.endswith((*ENDINGS, *IMAGE_ENDINGS)):
            return words.endswith(ENDINGS)
        return len(re.findall(r"[0-9]\.[0-9]", head(self.files[0]))) > 5

    @cached_property
    def keys(self) -> Keys:
        """The key of the files."""
        parts = [(file.stem, *reversed(file.parent.parts)) for file in self.files]
        # In folders of their own, files of one name are identified by these.
        names = next((each for each in zip(*parts, strict=False) if len({*each}) == len(parts)), ())
        return Keys.of(len(self.files), {"": names} if names else {}, numbers=self.numbers)

    @cached_property
    def image(self) -> ImageKind | None:
        """The kind of the images, by the first that can be read."""
        return next(filter(None, map(image_kind, self.files[:3])), None)

    @property
    def is_depth(self) -> bool:
        """Whether they are depth pictures or clouds."""
        return self.is_clouds or (self.image is not None and self.image.is_depth)

    @property
    def is_clouds(self) -> bool:
        """Whether they are clouds by their names and size: an array of a pose has few numbers."""
        is_named = len(self.files) > 1 and self.label.lower().endswith(CLOUD_ENDINGS)
        return is_named and self.files[0].stat().st_size > _LEAST_OF_CLOUD

    def taken(self, rows: IntArray) -> tuple[Path | None, ...]:
        """The files of some rows; None of -1."""
        return tuple(self.files[at] if at >= 0 else None for at in rows)

    def listed(self) -> str:
        """The label and the number of files, for messages."""
        return self.label if len(self.files) == 1 else f"{self.label} ({len(self.files)} files)"


def groups_in(source: Path) -> tuple[FileGroup, ...]:
    """The files of a source in groups of one kind, down to `_DEPTH` folders below it; pure."""
    if not source.is_dir():
        return (FileGroup(source.name, (source,), is_source=True),)
    alike: dict[tuple[str, str], list[Path]] = defaultdict(list)
    every = [*islice(_walked(source, _DEPTH), _FEW_FILES)]
    if len(every) == _FEW_FILES:
        every = [*islice(_walked(source, _LESS_DEEP), _MOST_FILES)]
    for file in every:
        path = file.relative_to(source)
        stem = re.sub(r"[0-9]+", "#", path.with_suffix("").as_posix())
        alike[stem, path.suffix.lower()].append(file)
    groups, single = list[FileGroup](), list[Path]()
    for (_, ending), files in alike.items():
        for group in _series(source, files, ending):
            if len(group.files) > 1:
                groups.append(group)
            else:
                single += group.files
    groups = [_with_first(group, single) for group in groups]
    single = [file for file in single if not any(file in group.files for group in groups)]
    groups += _in_folders(source, single)
    grouped = {file for group in groups for file in group.files}
    # Of any names: images of a folder, and records that are called as images are.
    stems = {file.stem for group in groups for file in group.files if group.is_images}
    stems |= {file.stem for file in single if is_image_name(file.name)}
    # Parts of a name are sought among the images' names: each with each would take hours of a disk.
    lengths = {len(stem) for stem in stems} - {1}
    kinds: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for file in single:
        if file in grouped:
            continue
        stem = file.stem
        is_named = is_image_name(file.name) or stem in stems
        is_named = is_named or any(
            stem[at : at + length] in stems
            for length in lengths
            for at in range(len(stem) - length + 1)
        )
        label = f"*{file.suffix.lower()}" if is_named else file.name
        kinds[file.parent.relative_to(source), label].append(file)
    for (folder, label), files in kinds.items():
        path = folder / (label if len(files) > 1 else files[0].name)
        groups.append(FileGroup(path.as_posix(), tuple(sorted(files, key=natural))))
    return tuple(sorted(groups, key=lambda group: _in_order(Path(group.label))))


def _with_first(group: FileGroup, single: Sequence[Path]) -> FileGroup:
    """A series with the file of its name without a number, as the first of those from 1 or 2 on."""
    stem = re.fullmatch(r"([^#]*[^#\W_])[\W_]*#\W?", Path(group.label).stem)
    if stem is None or min(group.numbers, default=0) not in (1, 2):
        return group
    first = group.files[0].with_name(f"{stem[1]}{group.files[0].suffix}")
    if first not in single:
        return group
    numbers = (min(group.numbers) - 1, *group.numbers)
    return replace(group, files=(first, *group.files), numbers=numbers)


def _in_folders(source: Path, single: Sequence[Path]) -> Iterator[FileGroup]:
    """Files of one name, in a folder a view."""
    by_name: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for file in single:
        if file.parent != source:
            by_name[file.parent.parent, file.name].append(file)
    for (folder, name), files in by_name.items():
        if len(files) > 2:
            label = (folder.relative_to(source) / "*" / name).as_posix()
            yield FileGroup(label, tuple(sorted(files, key=natural)))


def _in_order(path: Path) -> tuple[object, ...]:
    return natural(Path(path.as_posix().replace("/", "|")))


def _series(source: Path, files: Sequence[Path], ending: str) -> Iterator[FileGroup]:
    """Files that differ in numbers alone, in series of their own where the last ones are alike."""
    files = sorted(files, key=_in_order)
    stems = (file.relative_to(source).with_suffix("").as_posix() for file in files)
    runs = [re.split(r"([0-9]+)", stem) for stem in stems]
    differing = [at for at in range(1, len(runs[0]), 2) if len({run[at] for run in runs}) > 1]
    label = "".join("#" if at in differing else part for at, part in enumerate(runs[0])) + ending
    numbered = (tuple(int(run[at][:18]) for run in runs) for at in reversed(differing))
    numbers = next((each for each in numbered if len({*each}) == len(each)), ())
    parts: dict[str, dict[Path, str]] = defaultdict(dict)
    last = max(differing, default=0)
    for file, run in zip(files, runs, strict=True):
        parts["".join(run[:last])][file] = run[last]
    folders: dict[Path, list[Path]] = defaultdict(list)
    for file in files:
        folders[file.parent].append(file)
    first, *others = parts.values()
    if others and len(first) > 1 and all({*first.values()} == {*each.values()} for each in others):
        for part in parts.values():
            yield from _series(source, [*part], ending)
    elif not numbers and len(folders) > 1 and min(map(len, folders.values())) > 2:
        # Of another number each, as several recordings have them.
        for of_folder in folders.values():
            yield from _series(source, of_folder, ending)
    else:
        yield FileGroup(label, tuple(files), numbers)


def _walked(folder: Path, depth: int) -> Iterator[Path]:
    """Files of a folder and of the folders in it."""
    yield from files_in(folder)
    if depth > 1:
        with suppress(OSError):
            for path in sorted(folder.iterdir()):
                if path.is_dir() and not path.is_symlink() and not path.name.startswith("."):
                    yield from _walked(path, depth - 1)


def files_in(folder: Path) -> tuple[Path, ...]:
    """Files of a folder in natural order; empty where it cannot be listed.

    Links that lead out of the folder are left out.
    """
    try:
        files = [path for path in folder.iterdir() if path.is_file()]
    except OSError:
        return ()
    inside = (file for file in files if not file.is_symlink() or is_inside(file, folder))
    return tuple(sorted(inside, key=natural))


def head(path: Path) -> str:
    """The beginning of a text file; empty where it is not text."""
    try:
        # Files of a kernel have no size, and some never answer.
        if is_image_name(path.name) or not path.stat().st_size:
            return ""
        with path.open("rb") as file:
            # Length that suffices to recognise a text file.
            data = file.read(16_384)
    except (OSError, ValueError):
        return ""
    return "" if b"\0" in data else data.decode("utf-8", "ignore")


def images_of(source: Path) -> tuple[FileGroup, ...]:
    """The groups of images in a source, and those of clouds."""
    return tuple(group for group in groups_in(source) if group.is_images or group.is_clouds)


def image_groups(folder: Path) -> tuple[FileGroup, ...]:
    """The images that a user names: those of a folder, or of the series of one file.

    Raises:
        DataError: There are none.
    """
    found = images_of(folder.parent if folder.is_file() else folder)
    found = tuple(group for group in found if folder.is_dir() or folder in group.files)
    if not any(group.is_images for group in found):
        raise DataError(
            f"{folder} must be a folder with images (png, jpg, tif, bmp, webp).",
            culprits=[str(folder)],
            next_step="Name the folder of the images with --images.",
        )
    return found


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
