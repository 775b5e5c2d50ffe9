"""The printed targets of a session: one, or several that the column `target` tells apart."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from visioncal.errors import DataError
from visioncal.files import did_you_mean, some_of
from visioncal.session.document import Declaration
from visioncal.session.table import View
from visioncal.targets import load_target, target_from_document
from visioncal.types import Target

# The column of views.csv that names the target of a row.
COLUMN = "target"


def read_targets(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[dict[str, Target], Mapping[str, Any] | None]:
    """Reads the targets that a session declares.

    Args:
        declaration: What it declares.
        folder: Relative paths start here; the working directory where None.
        document: The content of the target's file, where that is known already; of several
            targets, the contents by their names.

    Returns:
        The targets by name, the name of an only one being empty, and their document in the form of
        the argument; None where there is none.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    places = declared_targets(declaration)
    if not places:
        return {}, document
    if len(places) == 1:
        (place,) = places.values()
        if document is None:
            target, document = load_target(place, folder)
        else:
            target = target_from_document(document, Path(place).stem)
        return {"": target}, document
    targets, contents = {}, {}
    for name, place in places.items():
        if document is None:
            targets[name], contents[name] = load_target(place, folder)
        elif name in document:
            targets[name] = target_from_document(document[name], Path(place).stem)
            contents[name] = document[name]
        else:
            raise DataError(
                f"session.toml: targets.{name}: its description is not among those given.",
                culprits=[f"session.toml: targets.{name}"],
            )
    return targets, contents


def declared_targets(declaration: Declaration) -> dict[str, str]:
    """The targets' built-in names or paths, by the names that rows give them."""
    if declaration.target is not None:
        return {"": declaration.target}
    return {name: table.target for name, table in declaration.targets.items()}


def check_targets_named(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks that rows name the targets that are declared.

    Raises:
        DataError: A row names none of several, or one that is not declared.
    """
    named = {view.number: view.text.get(COLUMN, "").strip() for view in views}
    declared = list(declaration.targets)
    if not declared:
        _check_one(declaration, sorted({it for it in named.values() if it}))
        return
    known = ", ".join(declared)
    unknown = {view: name for view, name in named.items() if name and name not in declared}
    if unknown:
        view, name = next(iter(unknown.items()))
        others = len(unknown) - 1
        raise DataError(
            f"views.csv, view {view}, column target: {name!r} is not declared; session.toml "
            f"declares {known}{f' ({others} more such rows)' if others else ''}.",
            culprits=[f"views.csv: view {it}" for it in unknown],
            next_step=did_you_mean(name, declared) or f"Add [targets.{name}], or correct the row.",
        )
    if len(declared) < 2:
        return
    looks = {view.number: bool(view.image) or "cft_x_m" in view.numbers for view in views}
    without = [str(view) for view, name in named.items() if not name and looks[view]]
    if without:
        raise DataError(
            f"views.csv: of several targets ({known}), the column target must name the one that a "
            f"row shows; it is empty in view {some_of(without)}.",
            culprits=[f"views.csv: view {it}" for it in without],
            next_step="Name the target in each of these rows; one image that shows several takes a "
            "row for each, with the same stop.",
        )


def _check_one(declaration: Declaration, names: Sequence[str]) -> None:
    """A session with one target, or none, may name it as it likes, but only one."""
    if len(names) < 2:
        return
    tables = ", ".join(f"[targets.{name}]" for name in names)
    raise DataError(
        f"views.csv, column target: it names {', '.join(names)}, but session.toml "
        f"{'has the one target for all' if declaration.target else 'declares none'}.",
        culprits=["session.toml: targets"],
        next_step=f"Declare {tables}, each with target = a name or a path.",
    )


def target_warnings(declaration: Declaration, views: Sequence[View]) -> Iterator[str]:
    """Words the targets that no row names."""
    if len(declaration.targets) < 2:
        return
    named = {view.text.get(COLUMN, "").strip() for view in views}
    for name in declaration.targets:
        if name not in named:
            yield f"session.toml: targets.{name}: no row of views.csv names it."
