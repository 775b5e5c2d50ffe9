"""Which pose each view allows and where its board is, with several boards.

The board with the most views comes first: its views alone say where the camera is. What every other
board's views say of that board's place is then compared, candidate by candidate, and the place on
which the better half agrees is taken (Rousseeuw 1984: the least trimmed sum of distances).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.errors import DegenerateError
from visioncal.estimation.observability import FEWEST_VIEWS
from visioncal.stages.choose import Choice, choose_by, choose_poses, has_rival
from visioncal.stages.pairwise import Candidates, consensus, trimmed
from visioncal.stages.pnp import ViewPoses
from visioncal.transforms import invert
from visioncal.types import FloatArray, Mask, Rejection, Target


@dataclass(frozen=True, eq=False)
class Layout:
    """The views with one pose each, and where their boards are.

    Attributes:
        choice: The views, and those that stay ambiguous.
        boards: Places of the boards that were seen among the session's, the one with the most views
            first.
        edges: (1 + b, 4, 4) the camera's and the boards' in that order, to begin with; None for one
            board, whose views say it by themselves.
    """

    choice: Choice
    boards: tuple[int, ...]
    edges: FloatArray | None = None


def lay_out(
    views: Sequence[ViewPoses],
    robot: FloatArray,
    targets: Mapping[str, Target],
) -> Layout:
    """Chooses each view's pose, and finds where the boards are.

    Args:
        views: The views with their candidates.
        robot: (m, 4, 4) the robot's part of the chain, one a view.
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
        return Layout(choice, (board,))
    first = boards[0]
    if len(parts[first]) < FEWEST_VIEWS:
        raise _too_few(parts, tuple(targets))
    choice = choose_poses(parts[first], robot[shown == first], stated[first])
    views_of = [it.view for it in parts[first]]
    rows = [views_of.index(it.view) for it in choice.views]
    _, found = trimmed(robot[shown == first][rows], Candidates.of(choice.views))
    typical = float(np.median(found.away.min(axis=1)))
    chosen, rejections, placed = [*choice.views], [*choice.rejections], [found.z]
    for board in boards[1:]:
        part, mine = parts[board], robot[shown == board]
        z, clear = _place_of(part, mine, found.x, typical)
        for view, predicted, it in zip(part, invert(mine @ found.x) @ z, clear, strict=True):
            if it:
                chosen.append(choose_by(view, predicted, stated[board]))
            else:
                why = "ambiguous: two poses of the target fit image and motion alike"
                rejections.append(Rejection(view.view, why))
        placed.append(z)
    order = {view.view: at for at, view in enumerate(views)}
    chosen.sort(key=lambda it: order[it.view])
    kept = [at for at, it in enumerate(boards) if any(view.board == it for view in chosen)]
    return Layout(
        Choice(tuple(chosen), tuple(rejections)),
        tuple(boards[at] for at in kept),
        np.array([found.x, *(placed[at] for at in kept)]),
    )


def _too_few(parts: Mapping[int, Sequence[ViewPoses]], names: Sequence[str]) -> DegenerateError:
    counts = ", ".join(f"{names[board]} in {len(part)}" for board, part in parts.items())
    return DegenerateError(
        f"hand-eye: of several targets, at least one must be seen in {FEWEST_VIEWS} views, to "
        f"begin with; here {counts}.",
        culprits=[f"target {names[board]}" for board in parts],
        next_step="Add views of one of them, tilted about different axes.",
    )


def _place_of(
    views: Sequence[ViewPoses], robot: FloatArray, x: FloatArray, typical: float
) -> tuple[FloatArray, Mask]:
    """Where a board is, (4, 4), and for which of its views the pose is clear."""
    candidates = Candidates.of(views).carried(robot @ x, np.eye(4)[None])
    z, away, _ = consensus(candidates)
    if len(views) == 1:
        # It has nothing that speaks for one of its poses.
        return z, np.array([np.sum(candidates.valid & (candidates.turns == 0)) == 1])
    return z, ~has_rival(candidates.distances(z[None]), max(away, typical))
