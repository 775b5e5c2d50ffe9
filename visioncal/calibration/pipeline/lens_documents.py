"""What is written of lenses and targets beside the frames."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.pipeline.lens_fields import lens_field_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.types import FloatArray, IntArray, TargetKind
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


def boards_of(known: RunState) -> dict[str, BoardResult]:
    """The boards as they were found to be, by name."""
    return {
        shape.name: BoardResult(
            shape=dict(zip(BOARD_NAMES, shape.values.tolist(), strict=True)),
            sigma={BOARD_NAMES[at]: float(shape.sigmas[at]) for at in shape.free},
            estimated=tuple(BOARD_NAMES[at] for at in shape.moving),
            bend_mm=1e3 * float(np.ptp(shape.corners[:, 2])),
        )
        for shape in _found_shapes(known)
        if shape.kind != "points"
    }


def rigs_of(known: RunState) -> dict[str, RigResult]:
    """The rigs as they were found to be, by name; those that are exact are left out."""
    return {
        shape.name: RigResult(shape=shape.values.reshape(-1, 3), sigma=shape.sigmas.reshape(-1, 3))
        for shape in _found_shapes(known)
        if shape.kind == "points" and shape.free
    }


@dataclass(frozen=True, eq=False)
class _FoundShape:
    """A target's shape: its values with their sigmas, and which of them are free and moved."""

    name: str
    kind: TargetKind
    values: FloatArray
    sigmas: FloatArray
    free: tuple[int, ...]
    moving: tuple[int, ...]
    corners: FloatArray


def _found_shapes(known: RunState) -> Iterator[_FoundShape]:
    """The shapes of the targets that were placed."""
    solved, covariance = known.fitted, known.solved.covariance
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return
    sigmas = np.zeros(len(looks.values))
    sigmas[seen.free] = np.sqrt(np.diag(covariance))[solved.columns_of(seen.free)]
    shapes = zip(_shapes(known).items(), known.session.boards.items(), looks.corners, strict=True)
    for (name, mine), (plate, target), corners in shapes:
        if frame_name("target", plate) in solved.part.tree.branches:
            yield _FoundShape(
                name,
                target.kind,
                looks.values[mine],
                sigmas[mine],
                _among(seen.free, mine),
                _among(seen.moving, mine),
                corners,
            )


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
    free = places[(places >= mine.start) & (places < mine.stop)]
    return tuple(int(value) for value in free - mine.start)
