"""Options that say what the task needs."""

from typing import Annotated, TypeAlias

import typer

NeedMm: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--need-mm",
        help="How near picks have to come, in mm: the verdict is about it. In the place of what "
        "the need in session.toml says.",
    ),
]
NeedDeg: TypeAlias = Annotated[
    float | None, typer.Option("--need-deg", help="The same in rotation, in degrees.")
]
