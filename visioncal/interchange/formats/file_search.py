"""Finds files: those of a source in groups of one kind, and the image of each row."""

import re
import shlex
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from os.path import commonpath
from pathlib import Path

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, is_inside, natural, read_bytes
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import IntArray
from visioncal.interchange.formats.fields import Fields, named_by
from visioncal.interchange.formats.keys import HOW, Keys, Match, is_image_name, matched, number_in
from visioncal.interchange.formats.reading import ENDINGS, SOURCES
from visioncal.session.images import CLOUD_ENDINGS, IMAGE_ENDINGS

# Endings of texts with numbers that are none of a recording.
_NO_DATA = (
    *(".py", ".md", ".html", ".sh", ".c", ".cc", ".cpp", ".h", ".ipynb", ".urdf", ".xacro", ".svg"),
    *(".m", ".sln", "cmakelists.txt", "requirements.txt", ".ply", ".pcd"),
)
# Folders below a source that are looked through, and the most files in all; a source of more files
# than a recording in folders has, such as a disk, is looked through less deep.
_DEPTH, _FEW_FILES, _LESS_DEEP, _MOST_FILES = 8, 5_000, 3, 100_000
# Fewest rows of which the motion may say which one has no image.
_FEWEST_PAIRED = 8
# Cells of rows without an image.
_NO_IMAGE = ("", "n/a", "none", "null", "nan")
# Words of pictures that a program drew: they are no camera's where there are others.
_DRAWN = re.compile(
    r"result|overlay|detect|corner|annot|draw|debug|visual|vis(?![a-z])|axes|axis|mask|plot|"
    r"preview|thumb|reproj|heat|undist|rectif",
    re.IGNORECASE,
)


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
        """Whether they are images by their names."""
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
        """Whether they are clouds by their names."""
        return len(self.files) > 1 and self.label.lower().endswith(CLOUD_ENDINGS)

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
    """Files of a folder and of those in it."""
    yield from files_in(folder)
    if depth > 1:
        with suppress(OSError):
            for path in sorted(folder.iterdir()):
                if path.is_dir() and not path.is_symlink() and not path.name.startswith("."):
                    yield from _walked(path, depth - 1)


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


def images_named(
    names: Sequence[str | None],
    base: Path,
    found: Sequence[FileGroup] = (),
    asked: Sequence[FileGroup] | None = None,
) -> tuple[Path | None, ...]:
    """(n,) paths of the images that rows name; of a missing image the one that the source states.

    Names are relative to `base`, or to the folder `images` in it, or of an image `found` in the
    source; among `asked`, if given, they are matched by their names, else by the numbers in these.
    Raises DataError.
    """
    files = [file for group in (found if asked is None else asked) for file in group.files]
    folders = {"", *(file.parent.name for file in files)}
    by_name = {
        (folder, word): file
        for file in files
        for folder in ("", file.parent.name)
        for word in (file.stem, file.name)
    }
    numbers = [number_in(name) for name in names if name]
    is_unique = asked is not None and len(set(numbers)) == len(numbers)
    by_number = {number_in(file.name): file for file in files} if is_unique else {}
    by_number = by_number if len(by_number) == len(files) else {}
    paths: list[Path | None] = []
    for name in names:
        path: Path | None = None
        if name and name.strip("-").lower() not in _NO_IMAGE:
            *_, folder, plain = ("", *name.replace("\\", "/").split("/"))
            known = by_name.get((folder if folder in folders else "", plain))
            known = known or by_number.get(number_in(plain))
            is_elsewhere = asked is not None or not is_inside(base / name, base)
            path = known if is_elsewhere else None
            path = path or path_inside(base, name if asked is None else plain)
            near = base / "images" / path.name
            if asked is None and not path.exists():
                path = near if is_inside(near, base) and near.exists() else known or path
        if path is not None and not is_image_name(path.name):
            raise DataError(
                f"{base}: an image is named {str(name)[:80]!r}, but must be a png, jpg, tif, "
                "bmp or webp.",
                culprits=[str(name)[:80]],
                next_step="Correct it, or name the column of the images with --image-column.",
            )
        paths.append(path)
    return tuple(paths)


@dataclass(frozen=True)
class Pairing:
    """The images of n rows."""

    images: tuple[Path | None, ...]  # (n,) the image of each row; None in a row without.
    notes: tuple[str, ...] = ()  # Pairs, and files that were left out.
    # (n,) images in other orders, where no names pair them, and what they are called.
    others: tuple[tuple[str, tuple[Path | None, ...]], ...] = ()
    is_open: bool = False  # Whether what the images show says which of these is right.
    doubt: DataError | None = None  # The error where nothing else says it.
    depths: tuple[Path | None, ...] = ()  # (n,) the depth of each row likewise; empty without any.


class UnpairedError(DataError):
    """Neither names nor numbers of images say which row each belongs to."""


def paired(fields: Fields, groups: Sequence[FileGroup]) -> Pairing:
    """Pairs rows with one kind of image: by equal names or numbers, else in natural order.

    Where one side has more, numbers may differ by a constant, which the images determine if several
    fit. Raises UnpairedError where nothing fits, and DataError where several kinds do.
    """
    matches, steps = list[tuple[FileGroup, Match]](), dict[str, list[Match]]()
    for group in groups:
        found = matched(fields.keys, group.keys)
        fewest = min(len(fields), len(group.files))
        if found is None or (found.how == HOW[1] and (found.rows >= 0).sum() < fewest):
            steps[group.label] = [*_in_step(fields, group)] or [*_one_over(fields, group)]
            found = found or next(iter(steps[group.label]), None)
        matches += [(group, found)] if found else []

    # A folder of all of them says nothing of one, as `bin/Debug`.
    shared = len(commonpath([group.label for group in groups]))

    def rank(item: tuple[FileGroup, Match]) -> tuple[object, ...]:
        group, found = item
        drawn = _DRAWN.search(group.label, shared) is not None
        is_named = re.search("rgb|colou?r", group.label, re.IGNORECASE) is not None
        # Drawings of another program, and pictures of some of the rows alone, come last.
        is_grey = group.image is not None and group.image.words.endswith("grey")
        left_over = int((found.rows < 0).sum())
        # Numbers that differ by a constant are no surer than as many of both.
        is_guess = bool(left_over) and found in steps.get(group.label, [])[:1]
        extra = (
            left_over,
            HOW.index(found.how),
            not is_named,
            is_grey,
            -len(group.files),
        )
        return group.is_depth, drawn, found.how == HOW[-1] or is_guess, *extra

    ranked = sorted(matches, key=rank)
    if not ranked:
        raise _unpaired(fields, max(groups, key=lambda group: len(group.files)))
    rivals = [group for group, _ in ranked if rank((group, _)) == rank(ranked[0])]
    if len(rivals) > 1:
        raise DataError(
            f"Each row has several images: {some_of([group.listed() for group in rivals])}.",
            culprits=[group.label for group in rivals],
            next_step=f"Say --images {shlex.quote(str(rivals[0].files[0]))}, or the first file of "
            "the others.",
        )
    (chosen, match), how = ranked[0], ranked[0][1].how
    images = chosen.taken(match.rows)
    both = [(place, file.name) for place, file in zip(fields.places, images, strict=True) if file]
    ends = ", ".join(f"{place} with {name}" for place, name in dict.fromkeys((both[0], both[-1])))
    hint = "; --image-column names a column that names each row's image" * (how == HOW[-1])
    notes = [f"Rows and images are paired by {how}: {ends}{hint}."]
    left = [group.listed() for group in groups if not (group is chosen or group.is_depth)]
    left += [file.name for file in sorted({*chosen.files}.difference(images), key=natural)]
    if left:
        notes.append(f"Left out of the images: {some_of(left)}.")
    others = steps.get(chosen.label, [])
    orders = _orders(fields, chosen, match, others).items()
    rest = tuple((words, each) for words, each in orders if each and each != images)
    is_sure = len(others) < 2 or match is not others[0]
    doubt = None if is_sure else _unpaired(fields, chosen)
    return Pairing(images, tuple(notes), rest, bool(others), doubt)


def with_depth(pairing: Pairing, groups: Sequence[FileGroup]) -> Pairing:
    """The pairing with the depth pictures or clouds of its images, by names or numbers."""
    images = tuple(dict.fromkeys(filter(None, pairing.images)))
    numbers = tuple(at for file in images if (at := number_in(file.name)) is not None)
    keys = FileGroup("", images, numbers * (len({*numbers}) == len(images))).keys
    notes, depths = list(pairing.notes), pairing.depths
    for group in (one for one in groups if one.is_depth and not {*one.files} & {*images}):
        found = matched(keys, group.keys)
        if depths or found is None or found.how == HOW[-1]:
            notes.append(f"The depth {group.listed()} is left out.")
            continue
        of = dict(zip(images, group.taken(found.rows), strict=True))
        depths = tuple(file and of[file] for file in pairing.images)
        unit = ", in millimetres unless [camera] depth_unit_m says otherwise"
        notes.append(
            f"The depth {group.listed()} is of the same images: it is the views' depth"
            f"{'' if group.is_clouds else unit}."
        )
    return replace(pairing, depths=depths, notes=tuple(notes))


def _orders(
    fields: Fields, chosen: FileGroup, match: Match, others: Sequence[Match]
) -> dict[str, tuple[Path | None, ...]]:
    """The rows' images in other orders, where no names pair them, and what they are called."""
    if match.how == HOW[0]:
        return {}
    files = chosen.files if len(chosen.files) == len(fields) else ()
    orders: dict[str, tuple[Path | None, ...]] = {
        "in natural order": files,
        "in the order of their names as texts": tuple(sorted(files, key=str)),
        "in reverse order": files[::-1],
    }
    moved = ((match.rows + by, match.rows) for by in (1, -1))
    one_off = (np.where((old < 0) | (rows >= len(chosen.files)), -1, rows) for rows, old in moved)
    for rows in [other.rows for other in others] or one_off:
        at = int(np.argmax(rows >= 0))
        words = f"from {chosen.files[rows[at]].name} with {fields.places[at]} on"
        if match.how == HOW[3] and len(chosen.files) != len(fields):
            left = {*range(len(chosen.files))} - {*rows.tolist()}
            lone = (
                fields.places[int(np.argmin(rows))],
                *(chosen.files[each].name for each in left),
            )
            words = f"in natural order, without {lone[-1]}"
        orders[words] = chosen.taken(rows)
    return orders


def _one_over(fields: Fields, group: FileGroup) -> Iterator[Match]:
    """Pairings in natural order with each row, or each file, in turn as the one that is over."""
    rows, files = len(fields), len(group.files)
    if min(rows, files) < _FEWEST_PAIRED or abs(rows - files) != 1:
        return
    for left in range(max(rows, files)):
        every = np.delete(np.arange(max(rows, files)), left)
        yield Match(HOW[3], every if files > rows else np.insert(np.arange(files), left, -1))


def _unpaired(fields: Fields, group: FileGroup) -> UnpairedError:
    """The error where nothing says which image is a row's."""
    first, last = group.files[0], group.files[-1]
    return UnpairedError(
        f"{first.parent} has {counted(len(group.files), 'image')} ({first.name} ... {last.name}), "
        f"but there are {len(fields)} poses ({fields.places[0]} ... {fields.places[-1]}), and "
        "neither names nor numbers say which belong together.",
        culprits=[str(first.parent)],
        next_step="Write each pose's image beside it, and name that with --image-"
        f"{named_by(fields.places[0]).rstrip('s')}, or remove what is over, wherever it is.",
    )


def _in_step(fields: Fields, group: FileGroup) -> Iterator[Match]:
    """Pairings by numbers that differ by a constant, the least first; all of the fewer find one.

    Rows without numbers count from one.
    """
    place = {number: at for at, number in enumerate(group.numbers)}
    for own in (*fields.keys.found[HOW[1]].values(), range(1, len(fields) + 1)):
        numbers = {number for number in own if isinstance(number, int)}
        fewer, more = sorted((numbers, {*place}), key=len)
        # Gaps in the numbers fit by chance less than numbers in a row.
        has_gaps = max(fewer, default=0) - min(fewer, default=0) >= len(fewer)
        if not 2 < len(fewer) <= len(more) < (4 if has_gaps else 2) * len(fewer):
            continue
        first, last, sign = min(fewer), max(fewer), 1 if len(numbers) <= len(place) else -1
        near = sorted((number - first for number in more), key=abs)
        # The last one tells most that do not fit; more than a few fit by chance.
        fits = (by for by in near if last + by in more and all(k + by in more for k in fewer))
        if steps := [*islice(fits, 9)]:
            for by in steps:
                at = (place.get(k + sign * by, -1) if isinstance(k, int) else -1 for k in own)
                yield Match(HOW[1], np.array([*at]))
            return


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
