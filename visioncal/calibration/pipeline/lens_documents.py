"""What is written of lenses and targets beside the frames."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.lens_fields import lens_field_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.solved import within
from visioncal.core.types import IntArray
from visioncal.estimation.appearance import BOARD_NAMES, shape_slices
from visioncal.results import CameraResult
from visioncal.results.sections import BoardResult, CellJointFit, RigResult
from visioncal.session import frame_name
from visioncal.session.frames import thing_name


def cameras_of(known: RunState) -> dict[str, CameraResult]:
    """The cameras by their frames, as the fit has them, with their covariance.

    A camera's covariance, the edges', and that of both together are blocks of one matrix. Given
    intrinsics of which only a part is uncertain, the matrix and not the distortion, have zeros for
    the rest.
    """
    solved, covariance, edges = known.fitted, known.solved.covariance, 6 * len(known.solved.edges)
    seen, looks = solved.seen, solved.looks
    # Measured poses do without a camera; whoever looks through it later does not.
    found = {
        frame: CameraResult(camera, estimated=False)
        for name, table in known.session.cameras.items()
        if (frame := frame_name("camera", name)) in solved.cell.tree.branches
        and (camera := table.stated) is not None
    }
    if seen is None or looks is None:
        return found | dict(known.lenses)
    for name, scene in known.scenes.items():
        lens = looks.lens_of(name)
        free = np.isin(lens, seen.free)
        estimated = scene.estimated or bool(np.isin(lens, seen.moving).any())
        found[name] = CameraResult(looks.camera(name), estimated)
        if free.any():
            at = solved.columns_of(lens[free])
            own, shared = np.zeros((len(lens),) * 2), np.zeros((len(lens), edges))
            own[np.ix_(free, free)] = covariance[np.ix_(at, at)]
            shared[free] = covariance[at, :edges]
            found[name] = CameraResult(looks.camera(name), estimated, own, shared)
        found[name] = replace(found[name], field=lens_field_of(solved, name, covariance, edges))
    return found


def fit_section(known: RunState) -> CellJointFit:
    """The unknowns of the fit of a whole cell, with their covariance."""
    solved, covariance, edges = known.fitted, known.solved.covariance, 6 * len(known.solved.edges)
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return CellJointFit(cameras={}, targets={}, covariance=covariance[:edges, :edges])
    columns = [*range(edges), *solved.columns_of(seen.free).tolist()]
    return CellJointFit(
        cameras={
            thing_name(name, "camera"): _among(seen.free, at) for name, at in looks.lenses.items()
        },
        targets={name: _among(seen.free, shape) for name, shape in _shapes(known).items()},
        covariance=covariance[np.ix_(columns, columns)],
    )


def shapes_of(known: RunState) -> tuple[dict[str, BoardResult], dict[str, RigResult]]:
    """The boards and the rigs as they were found to be, by name; exact rigs are left out."""
    solved, covariance = known.fitted, known.solved.covariance
    seen, looks = solved.seen, solved.looks
    boards, rigs = dict[str, BoardResult](), dict[str, RigResult]()
    if seen is None or looks is None:
        return boards, rigs
    every = np.zeros(len(looks.values))
    every[seen.free] = np.sqrt(np.diag(covariance))[solved.columns_of(seen.free)]
    shapes = zip(_shapes(known).items(), known.session.boards.items(), looks.corners, strict=True)
    for (name, mine), (plate, target), corners in shapes:
        if frame_name("target", plate) not in solved.part.tree.branches:
            continue
        values, sigmas, free = looks.values[mine], every[mine], _among(seen.free, mine)
        if target.kind != "points":
            boards[name] = BoardResult(
                shape=dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                sigma={BOARD_NAMES[at]: float(sigmas[at]) for at in free},
                estimated=tuple(BOARD_NAMES[at] for at in _among(seen.moving, mine)),
                bend_mm=1e3 * float(np.ptp(corners[:, 2])),
            )
        elif free:
            rigs[name] = RigResult(shape=values.reshape(-1, 3), sigma=sigmas.reshape(-1, 3))
    return boards, rigs


def _shapes(known: RunState) -> dict[str, slice]:
    """Where each target's shape stands among the values of lenses and boards."""
    looks = known.fitted.looks
    if looks is None:
        return {}
    targets = tuple(known.session.boards.values())
    names = tuple(name or "target" for name in known.session.plates) or ("target",)
    return dict(zip(names, shape_slices(targets, looks.boards.start), strict=True))


def _among(places: IntArray, mine: slice) -> tuple[int, ...]:
    """Which values of a lens or a target are among some, from its own first on."""
    return tuple(int(value) for value in within(places, mine) - mine.start)
