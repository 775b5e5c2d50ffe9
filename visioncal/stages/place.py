"""Which pose each view allows and where its board is, with several boards.

The board with the most views comes first: its views alone say where the camera is. What every other
board's views say of that board's place is then compared, candidate by candidate, and the place on
which the better half agrees is taken (Rousseeuw 1984: the least trimmed sum of distances).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.errors import DegenerateError
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.closure import Closure, Edges, distances
from visioncal.estimation.observability import FEWEST_VIEWS
from visioncal.estimation.outliers import inliers
from visioncal.stages.choose import (
    CLEAR_RATIO,
    Candidates,
    Choice,
    choose_by,
    choose_poses,
    distances_to,
    padded,
)
from visioncal.stages.pnp import ViewPoses
from visioncal.threads import one_blas_thread
from visioncal.transforms import invert, mean_transform
from visioncal.types import FloatArray, Mask, Mount, Rejection, Target


@dataclass(frozen=True, eq=False)
class Layout:
    """The views with one pose each, and where their boards are.

    Attributes:
        choice: The views, and those that stay ambiguous.
        boards: Places of the boards that were seen among the session's, the one with the most views
            first.
        from_first: (b, 4, 4) `target_k_from_target_1` in that order, to begin with.
    """

    choice: Choice
    boards: tuple[int, ...]
    from_first: FloatArray


def lay_out(
    views: Sequence[ViewPoses],
    robot: FloatArray,
    mount: Mount,
    targets: Mapping[str, Target],
) -> Layout:
    """Chooses each view's pose, and finds where the boards are.

    Args:
        views: The views with their candidates.
        robot: (m, 4, 4) the robot's part of the chain, one a view.
        mount: Where the camera is.
        targets: The session's targets by name.

    Raises:
        DegenerateError: The motion leaves most views ambiguous, or no board has enough views to
            begin with.
    """
    shown = np.array([it.board for it in views], dtype=np.int64)
    boards = sorted(set(shown.tolist()), key=lambda it: (-int(np.sum(shown == it)), it))
    stated: list[Target | None] = [*targets.values()] or [None]
    parts = {it: [view for view in views if view.board == it] for it in boards}
    if len(boards) < 2:
        board = boards[0] if boards else 0
        choice = choose_poses(views, robot, stated[board])
        return Layout(choice, (board,), np.eye(4)[None])
    first = boards[0]
    if len(parts[first]) < FEWEST_VIEWS:
        raise _too_few(parts, tuple(targets))
    choice = choose_poses(parts[first], robot[shown == first], stated[first])
    edges, typical = _edges(choice, parts[first], robot[shown == first], mount)
    chosen, rejections, from_first = [*choice.views], [*choice.rejections], [np.eye(4)]
    for board in boards[1:]:
        part, mine = parts[board], robot[shown == board]
        z, clear = _place_of(part, mine, edges.x, typical)
        at = Edges(edges.x, z, edges.shared)
        for view, stop, it in zip(part, mine, clear, strict=True):
            if it:
                chosen.append(choose_by(view, stop, at, stated[board]))
            else:
                why = "ambiguous: two poses of the target fit image and motion alike"
                rejections.append(Rejection(view.view, why))
        from_first.append(invert(z) @ edges.z)
    order = {view.view: at for at, view in enumerate(views)}
    chosen.sort(key=lambda it: order[it.view])
    kept = [at for at, it in enumerate(boards) if any(view.board == it for view in chosen)]
    return Layout(
        Choice(tuple(chosen), tuple(rejections)),
        tuple(boards[at] for at in kept),
        np.array(from_first)[kept],
    )


def _too_few(parts: Mapping[int, Sequence[ViewPoses]], names: Sequence[str]) -> DegenerateError:
    counts = ", ".join(f"{names[board]} in {len(part)}" for board, part in parts.items())
    return DegenerateError(
        f"hand-eye: of several targets, at least one must be seen in {FEWEST_VIEWS} views, to "
        f"begin with; here {counts}.",
        culprits=[f"target {names[board]}" for board in parts],
        next_step="Add views of one of them, tilted about different axes.",
    )


def _edges(
    choice: Choice, views: Sequence[ViewPoses], robot: FloatArray, mount: Mount
) -> tuple[Edges, float]:
    """Both edges by the views of one board, and how far off they typically place it [m]."""
    rows = [[it.view for it in views].index(it.view) for it in choice.views]
    camera = np.array([it.cam_from_target[0] for it in choice.views])
    data = Closure(mount, robot[rows], camera)
    with one_blas_thread():
        state = inliers(data.problem).fit.state
    edges = Edges(state.edges[0], state.edges[1], state.values)
    away_m, away_rad = distances(data.placed(edges.x), edges.z)
    return edges, float(np.median(away_m + LEVER_M * away_rad))


def _place_of(
    views: Sequence[ViewPoses], robot: FloatArray, x: FloatArray, typical: float
) -> tuple[FloatArray, Mask]:
    """Where a board is, (4, 4), and for which of its views the pose is clear."""
    candidates = padded(views)
    # A turn of the board in all views alike is a change of its frame, and no other place.
    own = np.array([[turn == 0 for turn in _filled(view, candidates)] for view in views])
    places = (robot[:, None] @ x @ candidates.poses)[own & candidates.valid]
    away = np.array([distances_to(robot, candidates, x, z) for z in places])
    nearest, half = away.min(axis=2), (len(views) + 1) // 2
    trimmed = np.sort(nearest, axis=1)[:, :half].mean(axis=1)
    best = int(trimmed.argmin())
    kept, picks = np.argsort(nearest[best])[:half], away[best].argmin(axis=1)
    z = mean_transform(robot[kept] @ x @ candidates.poses[kept, picks[kept]])
    if len(views) == 1:
        # It has nothing that speaks for one of its poses.
        return z, np.array([len(places) == 1])
    ordered = np.sort(distances_to(robot, candidates, x, z), axis=1)
    limit = CLEAR_RATIO * max(float(trimmed[best]), typical)
    # A view far from all others with any of its poses is wrong, which is for others to say.
    rival = np.zeros(len(views), dtype=bool)
    if ordered.shape[1] > 1:
        rival = ordered[:, 1] < np.maximum(limit, CLEAR_RATIO * ordered[:, 0])
    return z, ~rival | (ordered[:, 0] > CLEAR_RATIO * limit)


def _filled(view: ViewPoses, candidates: Candidates) -> tuple[int, ...]:
    """The turns of a view's candidates, padded as they are."""
    more = int(candidates.valid.shape[1]) - len(view.turns)
    return view.turns + view.turns[-1:] * more
