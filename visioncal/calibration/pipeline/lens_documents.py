"""What is written of lenses and targets beside the frames."""

from typing import Any

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.types import IntArray
from visioncal.estimation.appearance import BOARD_NAMES, shape_slices
from visioncal.results import CameraResult
from visioncal.session import frame_name
from visioncal.session.frames import thing_name


def cameras_of(known: RunState) -> dict[str, CameraResult]:
    """The cameras by their frames, as the fit has them, with what is open about them.

    A camera's covariance, the edges', and that of both together are blocks of one matrix. Given
    intrinsics of which only a part is open, the matrix and not the distortion, have zeros for the
    rest.
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
    return found


def fit_section(known: RunState) -> dict[str, Any]:
    """`joint_fit` of a whole cell.

    That is which values of each camera's lens and each target's shape are among the unknowns,
    cameras first, and the covariance of transforms and these.
    """
    solved, covariance, edges = known.fitted, known.solved.covariance, 6 * len(known.solved.edges)
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return {"cameras": {}, "targets": {}, "covariance": covariance[:edges, :edges].tolist()}
    columns = [*range(edges), *solved.columns_of(seen.free).tolist()]
    return {
        "cameras": {
            thing_name(it, "camera"): _among(seen.free, at) for it, at in looks.lenses.items()
        },
        "targets": {name: _among(seen.free, it) for name, it in _shapes(known).items()},
        "covariance": covariance[np.ix_(columns, columns)].tolist(),
    }


def shape_sections(known: RunState) -> dict[str, Any]:
    """`boards` and `rigs`: the targets as they were found to be; of rigs those that are not exact.

    Where there is one target without a name they are `board` or `rig`, without another key.
    """
    solved, covariance = known.fitted, known.solved.covariance
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return {}
    sigmas = np.zeros(len(looks.values))
    sigmas[seen.free] = np.sqrt(np.diag(covariance))[solved.columns_of(seen.free)]
    found: dict[str, dict[str, Any]] = {"boards": {}, "rigs": {}}
    boards, placed = known.session.boards, solved.part.tree.branches
    shapes = zip(_shapes(known).items(), boards.items(), strict=True)
    for at, ((name, mine), (plate, target)) in enumerate(shapes):
        if frame_name("target", plate) not in placed:
            continue
        values, known_to, free = looks.values[mine], sigmas[mine], _among(seen.free, mine)
        if target.kind == "points" and free:
            found["rigs"][name] = {
                "shape": values.reshape(-1, 3).tolist(),
                "sigma": known_to.reshape(-1, 3).tolist(),
            }
        elif target.kind != "points":
            found["boards"][name] = {
                "shape": dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                "sigma": {BOARD_NAMES[it]: float(known_to[it]) for it in free},
                "estimated": [BOARD_NAMES[it] for it in _among(seen.moving, mine)],
                "bend_mm": 1e3 * float(np.ptp(looks.corners[at][:, 2])),
            }
    if known.mount is not None and not known.session.targets:
        return {kind[:-1]: it for kind, of in found.items() for it in of.values()}
    return {kind: it for kind, it in found.items() if it}


def _shapes(known: RunState) -> dict[str, slice]:
    """Where each target's shape stands among the values of lenses and boards."""
    looks = known.fitted.looks
    if looks is None:
        return {}
    targets = tuple(known.session.boards.values())
    names = tuple(name or "target" for name in known.session.plates) or ("target",)
    return dict(zip(names, shape_slices(targets, looks.boards.start), strict=True))


def _among(places: IntArray, mine: slice) -> list[int]:
    """Which values of a lens or a target are among some, from its own first on."""
    free = places[(places >= mine.start) & (places < mine.stop)]
    return [int(it) for it in free - mine.start]
