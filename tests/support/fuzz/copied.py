"""Sessions of all kinds, and copies of their rows: exact ones, and ones that jitter."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from visioncal.session import Session
from visioncal.session.corners import CornerTable
from visioncal.simulation import (
    CellOptions,
    SweepOptions,
    WarmUpOptions,
    cell_session,
    read_cell,
    simulate,
    simulate_warm_up,
    sweep,
)
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, session_of, tracked
from visioncal.simulation.recordings import Round

_PLACES = tuple(f"{of}{axis}_m" for of in ("", "cft_", "meas_") for axis in "xyz")
_MOUNTS = ("eye-in-hand", "eye-to-hand")


def copied(
    session: Session, times: int, jitter_m: float = 0.0, *, seed: int = 0, interleaved: bool = False
) -> Session:
    """A session with every row so many times; all positions of the copies jitter.

    Interleaved copies follow their rows; others follow the whole session.
    """
    rng, step = np.random.default_rng(seed), 1 + max(view.number for view in session.views)
    views = []
    for copy in range(times):
        for at, view in enumerate(session.views):
            moved = {
                name: value + jitter_m * rng.standard_normal()
                for name, value in view.numbers.items()
                if copy and name in _PLACES
            }
            number = view.number + copy * step
            row = replace(view, number=number, numbers={**view.numbers, **moved})
            views.append(((at, copy) if interleaved else (copy, at), row))
    table = session.corner_table
    if table is not None:
        table = CornerTable(
            np.concatenate([table.views + copy * step for copy in range(times)]),
            np.tile(table.points, times),
            np.tile(table.px, (times, 1)),
            table.targets * times,
        )
    rows = [row for _, row in sorted(views, key=lambda item: item[0])]
    return Session.assemble(
        session.document,
        session.columns,
        [[row.cell(column) for column in session.columns] for row in rows],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=table,
    ).with_streams(session.streams)


def _of_one_robot(seed: int, seen: str, **options: object) -> Session:
    mount = _MOUNTS[seed // 10 % 2]
    return cell_session(simulate(CellOptions(mount=mount, seed=seed, **options)), "cell", seen=seen)


def _without_joints(session: Session) -> Session:
    columns = [name for name in session.columns if name == "qx" or name[1:2] not in "123456"]
    document = {name: value for name, value in session.document.items() if name != "robot"}
    rows = [[view.cell(column) for column in columns] for view in session.views]
    return Session.assemble(
        document,
        columns,
        rows,
        session.images,
        target_document=session.target_document,
        corners=session.corner_table,
    )


def _of_a_cell(seed: int, name: str) -> Session:
    cell = simulate(replace(read_cell(name), stops=16, seed=seed))
    return cell_session(cell, "cell", seen="corners")


def _tracked(seed: int, **options: object) -> Session:
    return session_of(tracked(InstrumentOptions(stops=24, seed=seed, **options)))


def _of_motion(seed: int, which: int) -> Session:
    if which == 0:
        return _tracked(seed, poses=True)
    options = CellOptions(seed=seed)
    if which == 1:
        return cell_session(
            simulate_warm_up(WarmUpOptions(options, round=Round(first=20))), "cell", seen="poses"
        )
    return cell_session(sweep(options, SweepOptions()), "cell", seen="poses")


ARM_OFF = {"dh_sigma_m": 3e-4, "dh_sigma_rad": 3e-4}
# Two mounts alternate with every tenth seed.
KINDS: Mapping[str, Callable[[int], Session]] = {
    "poses and joints": lambda seed: _of_one_robot(seed, "poses", views=12),
    "poses of a wrong arm": lambda seed: _of_one_robot(seed, "poses", views=30, **ARM_OFF),
    "poses without joints": lambda seed: _without_joints(_of_one_robot(seed, "poses", views=14)),
    "corners": lambda seed: _of_one_robot(seed, "corners", views=12),
    "corners, lens estimated": lambda seed: _without_joints(
        _of_one_robot(seed, "corners", views=16, state_intrinsics=False)
    ),
    "images": lambda seed: _of_one_robot(seed, "images", views=8),
    "two cameras": lambda seed: _of_a_cell(seed, "two-cameras"),
    "two arms or a tracker": lambda seed: _of_a_cell(
        seed, ("two-arms", "camera-and-tracker")[seed // 10 % 2]
    ),
    "an instrument's points": lambda seed: _tracked(seed, points=THREE[: 1 + 2 * (seed // 10 % 2)]),
    "a probe, a warm-up or a sweep": lambda seed: _of_motion(seed, seed // 10 % 3),
}


def session_of_kind(seed: int) -> tuple[str, Session]:
    """One of ten kinds of sessions in turn, with its kind."""
    kind = list(KINDS)[seed % len(KINDS)]
    return kind, KINDS[kind](seed)
