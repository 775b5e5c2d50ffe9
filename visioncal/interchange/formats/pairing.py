"""Files that belong to rows of a table: by names, numbers, times or order."""

import filecmp
import re
import shlex
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from os.path import commonpath
from pathlib import Path, PureWindowsPath

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import is_inside, natural
from visioncal.core.number_format import counted, some_of
from visioncal.interchange.formats.fields import Fields, named_by
from visioncal.interchange.formats.file_search import DRAWN, FileGroup, path_inside
from visioncal.interchange.formats.keys import HOW, Match, is_image_name, matched, number_in

# Fewest rows of which the motion may say which one has no image.
_FEWEST_PAIRED = 8
# Names of columns that name images, and cells of rows without one.
_IMAGE_NAMES = ("image", "img", "filename", "file", "image_file", "image_path")
_NO_IMAGE = ("", "n/a", "none", "null", "nan")


def images_named(
    names: Sequence[str | None],
    base: Path,
    found: Sequence[FileGroup] = (),
    given: Sequence[FileGroup] | None = None,
) -> tuple[Path | None, ...]:
    """(n,) paths of the images that rows name; of a missing image the one that the source states.

    Names are relative to `base`, or to the folder `images` in it, or of an image `found` in the
    source; among `given` ones, if any, they are matched by their names, else by the numbers in
    these. Raises DataError.
    """
    files = [file for group in (found if given is None else given) for file in group.files]
    folders = {"", *(file.parent.name for file in files)}
    by_name = {
        (folder, word): file
        for file in files
        for folder in ("", file.parent.name)
        for word in (file.stem, file.name)
    }
    numbers = [number_in(name) for name in names if name]
    is_unique = given is not None and len(set(numbers)) == len(numbers)
    by_number = {number_in(file.name): file for file in files} if is_unique else {}
    by_number = by_number if len(by_number) == len(files) else {}
    paths: list[Path | None] = []
    for name in names:
        path: Path | None = None
        if name and name.strip("-").lower() not in _NO_IMAGE:
            *_, folder, plain = ("", *name.replace("\\", "/").split("/"))
            known = by_name.get((folder if folder in folders else "", plain))
            known = known or by_number.get(number_in(plain))
            is_elsewhere = given is not None or not is_inside(base / name, base)
            path = known if is_elsewhere else None
            path = path or path_inside(base, name if given is None else plain)
            near = base / "images" / path.name
            if given is None and not path.exists():
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


def image_column(fields: Fields, groups: Sequence[FileGroup], taken: Collection[str]) -> str:
    """Finds the field that names images, by its name or its cells; empty where none does."""
    free = {name: cells for name, cells in fields.texts.items() if name not in taken}
    usual = (name for name in _IMAGE_NAMES if any(map(is_image_name, free.get(name, ()))))
    if name := next(usual, ""):
        return name
    pictures = [group for group in groups if not group.is_depth] or groups
    files = [file for group in pictures for file in group.files]
    named = {file.stem: file for file in files} | {file.name: file for file in files}
    naming = {
        name: tuple(named.get(PureWindowsPath(cell).name) for cell in cells)
        for name, cells in free.items()
        if any(cells) and all(not cell or is_image_name(cell) or cell in named for cell in cells)
    }
    if most := max((len(found) - found.count(None) for found in naming.values()), default=0):
        # Others name pictures of some rows alone, or that another program drew.
        naming = {n: found for n, found in naming.items() if len(found) - found.count(None) == most}
        seen = {n: found for n, found in naming.items() if not any(map(_is_drawn, found))}
        naming = seen or naming
    # Several columns may name the same images.
    if len({*naming.values()}) > 1:
        raise DataError(
            f"{fields.name}: {some_of([*naming])} all name images: one of them must be chosen.",
            culprits=[*naming],
            next_step=f"Say which with --image-{named_by(fields.places[0]).rstrip('s')}.",
        )
    return max(naming, key=lambda name: is_image_name(free[name][0]), default="")


def _is_drawn(file: Path | None) -> bool:
    return file is not None and DRAWN.search(f"{file.parent.name}/{file.name}") is not None


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
        drawn = DRAWN.search(group.label, shared) is not None
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
    if len(rivals) > 1 and not _are_one(rivals, len(fields)):
        raise DataError(
            f"Each row has several images: {some_of([group.listed() for group in rivals])}.",
            culprits=[group.label for group in rivals],
            next_step=f"Give --images {shlex.quote(str(rivals[0].files[0]))}, or the first file of "
            "the others.",
        )
    (chosen, match), how = ranked[0], ranked[0][1].how
    images = chosen.taken(match.rows)
    pairs = [(place, file.name) for place, file in zip(fields.places, images, strict=True) if file]
    ends = ", ".join(f"{place} with {name}" for place, name in dict.fromkeys((pairs[0], pairs[-1])))
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
        is_float = group.image is not None and group.image.words.startswith("32")
        unit = f", in {'metres' if is_float else 'millimetres'} unless [camera] depth_unit_m says "
        unit += "otherwise"
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
    """Pairings in natural order, leaving out each row, or each file, in turn."""
    rows, files = len(fields), len(group.files)
    if min(rows, files) < _FEWEST_PAIRED or abs(rows - files) != 1:
        return
    for left in range(max(rows, files)):
        every = np.delete(np.arange(max(rows, files)), left)
        yield Match(HOW[3], every if files > rows else np.insert(np.arange(files), left, -1))


def _are_one(groups: Sequence[FileGroup], count: int) -> bool:
    """Whether groups have the same pictures, one a row, as in a folder that was copied."""
    first, *others = groups
    pairs = (pair for other in others for pair in zip(first.files, other.files, strict=False))
    is_whole = {len(group.files) for group in groups} == {count}
    return is_whole and all(filecmp.cmp(*pair, shallow=False) for pair in pairs)


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
    for keys in (*fields.keys.found[HOW[1]].values(), range(1, len(fields) + 1)):
        numbers = {number for number in keys if isinstance(number, int)}
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
                at = (place.get(k + sign * by, -1) if isinstance(k, int) else -1 for k in keys)
                yield Match(HOW[1], np.array([*at]))
            return
