"""Sightings linearised at a state: a Gram matrix each, of its pose and its own columns.

The rows of a sighting depend on its pose `seer_from_seen` and on what lens, board and field add.
Its pose depends on the errors of the flanges in its path, on the edges, and on effects that move
them. Thus every derivative is a small matrix times one Gram matrix (cf. the reduced camera matrix
of Triggs, McLauchlan, Hartley and Fitzgibbon 2000, section 6), and nothing beyond this module
grows with the number of corners.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import (
    adjoint,
    apply,
    apply_each,
    compose,
    exp,
    inverse_right_jacobian,
    invert,
    log,
    skew,
)
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.fit.mixed import weights_at
from visioncal.fit.pairs import Pair
from visioncal.fit.unknowns import Key, State, Unknowns
from visioncal.model import Cell, MeasuredPlace, MeasuredPose, Moments
from visioncal.model.effects import Displacement, Rolling, RowMotion
from visioncal.session.tree import PathStep
from visioncal.vision.camera import project_with_jacobian


@dataclass(frozen=True, eq=False)
class Products:
    """Gram matrices of the rows of k sightings that have one size.

    Local columns are a head of h (pose: 6, lens, board), then a field's 2 r, then the residual: d +
    1 in all. A field's functions are the same along both axes of the image.
    """

    size: int  # -1 for rows that are whitened already.
    counts: FloatArray  # (k,) numbers of rows.
    heads: FloatArray  # (k, h, d + 1) of the head's columns with all.
    functions: FloatArray  # (k, r, r) of a field's functions with each other, along either axis.
    pulls: FloatArray  # (k, 2 r) of the field's columns with the residual.
    squares: FloatArray  # (k,) of the residual.
    # (k, 6, 2 r) whitened rows by poses alone, whose products are to be added to `functions`.
    posed: FloatArray
    sign: float = 1.0  # Of these products.

    def summed(self) -> FloatArray:
        """(d + 1, d + 1) sum of the sightings' Gram matrices."""
        h, r = self.heads.shape[1], self.functions.shape[1]
        found = np.zeros((h + 2 * r + 1, h + 2 * r + 1))
        found[:h] = self.heads.sum(axis=0)
        found[:, :h] = found[:h].T
        found[h : h + r, h : h + r] = found[h + r : -1, h + r : -1] = self.functions.sum(axis=0)
        found[h:-1, h:-1] += self.sign * np.tensordot(self.posed, self.posed, ((0, 1), (0, 1)))
        found[h:-1, -1] = found[-1, h:-1] = self.pulls.sum(axis=0)
        found[-1, -1] = self.squares.sum()
        return found

    def take(self, mask: Mask) -> "Products":
        """The products of the sightings in a mask."""
        return replace(
            self, counts=self.counts[mask], heads=self.heads[mask], squares=self.squares[mask],
            functions=self.functions[mask], pulls=self.pulls[mask], posed=self.posed[mask],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Gram:
    """The k sightings of one frame by another.

    Common columns are the c that act on the pose or the lens through `moves`, of which the first f
    are errors of flanges, then those that act on local columns alike in all sightings.
    """

    pair: tuple[str, str]  # Seer and seen.
    rows: IntArray  # (k,) indices of the sightings.
    stops: IntArray  # (k,)
    moments: Moments  # (k) theirs.
    distances: FloatArray  # (k,) of the board's middle along the camera's axis [m]; ones elsewhere.
    parts: tuple[Products, ...]  # By size.
    flanges: tuple[str, ...]  # Those in the path that err.
    moves: FloatArray  # (k, m, f + c) of the first m local columns by errors and common columns.
    fixed: FloatArray  # (d, n) of the local columns by the others.
    columns: IntArray  # (c + n,) of the unknowns.
    poses: FloatArray  # (k, 4, 4) `seer_from_seen` as predicted.
    by_effects: Mapping[str, FloatArray]  # (k, 6, 6) of the pose by effects on each edge.

    @property
    def head(self) -> int:
        """The number h of local columns of pose, lens and board."""
        return int(self.parts[0].heads.shape[1])

    def heads(self, logs: FloatArray) -> FloatArray:
        """(k, h, d + 1) products of the head's columns, of rows in units of their noise."""
        weights = weights_at(logs)
        return np.asarray(sum(weights[part.size] * part.heads for part in self.parts))

    def squares(self, logs: FloatArray) -> FloatArray:
        """(k,) squares of the residuals, in units of their noise."""
        weights = weights_at(logs)
        return np.asarray(sum(weights[part.size] * part.squares for part in self.parts))

    def by_unknowns(self, local: FloatArray) -> FloatArray:
        """(k, a, f + c + n) by errors and unknowns, of (k, a, d) by local columns."""
        moved = local[:, :, : self.moves.shape[1]] @ self.moves
        return np.concatenate([moved, local @ self.fixed], axis=2)

    def by_errors_and_sum(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k, a, f) by errors, of (k, a, d) by local columns; (a, c + n) by unknowns, summed."""
        moved, f = local[:, :, : self.moves.shape[1]] @ self.moves, 6 * len(self.flanges)
        summed = moved[:, :, f:].sum(axis=0), local.sum(axis=0) @ self.fixed
        return moved[:, :, :f], np.concatenate(summed, axis=1)

    def in_common(self, part: Products) -> tuple[FloatArray, FloatArray]:
        """Gram matrices by errors, unknowns and residual.

        Returns:
            Those of errors with all (k, f, f + c + n + 1); those of unknowns and residual, summed
            over the sightings (c + n + 1, c + n + 1).
        """
        f, moves = 6 * len(self.flanges), self.moves
        by_local = np.swapaxes(moves, 1, 2) @ part.heads[:, : moves.shape[1]]
        of_errors, rest = by_local[:, :f], by_local[:, f:]
        by_all = np.concatenate(
            [self.by_unknowns(of_errors[:, :, :-1]), of_errors[:, :, -1:]], axis=2
        )
        c, fixed = moves.shape[2] - f, np.pad(self.fixed, (0, 1))
        fixed[-1, -1] = 1.0
        common = np.zeros((len(self.columns) + 1, len(self.columns) + 1))
        common[:c, :-1] = self.by_errors_and_sum(rest[:, :, :-1])[1]
        common[:c, -1] = rest[:, :, -1].sum(axis=0)
        common[:, :c] = common[:c].T
        common[c:, c:] = fixed.T @ part.summed() @ fixed
        return by_all, common

    def take(self, mask: Mask) -> "Gram":
        """The matrices of the sightings in a mask."""
        return replace(
            self,
            rows=self.rows[mask], stops=self.stops[mask], moves=self.moves[mask],
            moments=self.moments.take(np.flatnonzero(mask)), distances=self.distances[mask],
            parts=tuple(part.take(mask) for part in self.parts), poses=self.poses[mask],
            by_effects={name: slope[mask] for name, slope in self.by_effects.items()},
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Predicted:
    """Poses as a path predicts them."""

    poses: FloatArray  # (k, 4, 4) `start_from_end`.
    # (k, 6, 6) of their right perturbations, by each edge in the path: an unknown one's own right
    # perturbation, a flange's error.
    slopes: Mapping[str, FloatArray]
    # The same by effects, which act behind an edge's own perturbation.
    by_effects: Mapping[str, FloatArray]


def predicted(
    cell: Cell,
    unknowns: Unknowns,
    state: State,
    path: tuple[PathStep, ...],
    moments: Moments,
    errors: Mapping[str, FloatArray],
) -> Predicted:
    """Predicts the poses along a path at k moments, with (k, 6) errors of some flanges."""
    count = len(moments)
    back, slopes = np.tile(np.eye(4), (count, 1, 1)), dict[str, FloatArray]()
    by_effects = dict[str, FloatArray]()
    for step in reversed(path):
        name = step.frame
        twist = errors.get(name, np.zeros((count, 6)))
        for effect in unknowns.effects:
            if effect.place == "edge" and effect.frame == name:
                twist = twist + effect.twists(moments, state.values["effect", effect.name])
        known = moments.poses[name] if step.robot else cell.tree.branches[name].known
        edge = state.values["edge", name] if known is None else known
        moved = exp(twist)
        edge = edge @ moved
        before, back = back, back @ (edge if step.is_up else invert(edge))
        slope = -adjoint(back) if step.is_up else adjoint(before)
        # Twists that exist already and the next ones do not commute.
        by_effects[name] = slope @ np.linalg.inv(inverse_right_jacobian(twist))
        slopes[name] = by_effects[name] if step.robot else slope @ adjoint(invert(moved))
    return Predicted(invert(back), slopes, by_effects)


def predicted_sightings(cell: Cell, unknowns: Unknowns, state: State, pair: Pair) -> Predicted:
    """Predicts the k sightings of a pair, with the errors of the flanges at their stops."""
    errors = {name: errors[pair.stops] for name, errors in state.errors.items()}
    return predicted(cell, unknowns, state, pair.path, pair.moments, errors)


def linearised(
    cell: Cell, unknowns: Unknowns, state: State, pairs: tuple[Pair, ...]
) -> tuple[Gram, ...]:
    """All sightings at a state, used or not."""
    return tuple(_linearised(cell, unknowns, state, pair) for pair in pairs)


def _linearised(cell: Cell, unknowns: Unknowns, state: State, pair: Pair) -> Gram:
    at = predicted_sightings(cell, unknowns, state, pair)
    distances = np.ones(len(at.poses))
    if pair.corners:
        distances = pair.distances(at.poses)
        rows = corner_rows(unknowns, state, pair, at.poses, pair.twists(at.by_effects))
        parts, local_columns = _corner_parts(unknowns, pair, rows), rows.local_columns
    else:
        parts, local_columns = _measured_parts(unknowns, state, pair, at.poses)
    seer, _ = pair.names
    frames = [step.frame for step in pair.path]
    flanges = tuple(name for name in unknowns.erring if name in frames)
    edges = [name for name in frames if ("edge", name) in unknowns]
    by_pose = [at.slopes[name] for name in (*flanges, *edges)]
    columns = [unknowns.columns("edge", name) for name in edges]
    inner, of_inner = list[tuple[int, FloatArray]](), dict[Key, IntArray]()
    for effect in unknowns.effects:
        known = unknowns.columns("effect", effect.name)
        if effect.place == "edge" and effect.frame in frames:
            values = state.values["effect", effect.name]
            slopes = effect.slopes(pair.moments, values)
            by_pose.append(at.by_effects[effect.frame] @ slopes)
            columns.append(known)
        elif effect.frame == seer and pair.corners and not isinstance(effect, Rolling):
            key: Key = ("effect", effect.name)
            first = int(local_columns[("lens", seer) if effect.place == "lens" else key][0])
            inner.append((first, effect.columns(pair.moments, distances)))
            of_inner[key] = known
    columns += of_inner.values()
    moves = np.concatenate([np.zeros((len(pair.rows), 6, 0)), *by_pose], axis=2)
    for first, by_local in inner:
        moves = _beside(moves, first, by_local)
    free = {key: at for key, at in local_columns.items() if key in unknowns and key not in of_inner}
    kept = {key: places[: unknowns[key].count] for key, places in free.items()}
    columns += [unknowns.columns(*key)[: len(places)] for key, places in kept.items()]
    places = np.concatenate([np.zeros(0, int), *kept.values()]).astype(np.int64)
    fixed = np.zeros((parts[0].heads.shape[2] - 1, len(places)))
    units = [unknowns[key].units[: len(places)] for key, places in kept.items()]
    fixed[places, np.arange(len(places))] = np.concatenate([np.zeros(0), *units])
    instead = unknowns.fields[seer].instead if ("field", seer) in kept else None
    if instead is not None:
        # A field's columns are last.
        fixed[local_columns["lens", seer], -instead.shape[1] :] = -instead
    return Gram(
        pair.names, pair.rows, pair.stops, pair.moments, distances, parts, flanges, moves, fixed,
        np.concatenate([np.zeros(0, int), *columns]), at.poses, at.by_effects,
    )  # fmt: skip


def _beside(moves: FloatArray, first: int, others: FloatArray) -> FloatArray:
    """Derivatives (k, m, c) of local columns beside (k, n, d) ones of those from `first` on."""
    (rows, old), (more, new) = moves.shape[1:], others.shape[1:]
    found = np.zeros((len(moves), max(rows, first + more), old + new))
    found[:, :rows, :old], found[:, first : first + more, old:] = moves, others
    return found


def _corner_parts(unknowns: Unknowns, pair: Pair, rows: "CornerRows") -> tuple[Products, ...]:
    """Products of corners: all with one noise, or what a pose explains with another."""
    px, view = (unknowns.size_of(f"{name} {pair.names[0]}") for name in ("px", "view"))
    counts, padded = np.asarray(2.0 * pair.counts), pair.padded
    left, head = (
        np.swapaxes(padded(rows.head).reshape(len(counts), -1, rows.count), 1, 2),
        rows.count,
    )
    by_axis = [np.swapaxes(padded(rows.head[:, axis]), 1, 2) for axis in (0, 1)]
    functions, residual = padded(rows.functions), padded(rows.residual)
    pulls = np.swapaxes(residual, 1, 2) @ functions
    heads = [left @ np.swapaxes(left, 1, 2), *(axis_head @ functions for axis_head in by_axis)]
    heads.append(left @ residual.reshape(len(counts), -1, 1))
    products = Products(
        px, counts, np.concatenate(heads, axis=2), np.swapaxes(functions, 1, 2) @ functions,
        pulls.reshape(len(counts), -1), np.sum(residual**2, axis=(1, 2)),
        np.zeros((len(counts), 0, 2 * functions.shape[2])),
    )  # fmt: skip
    if view < 0:
        return (products,)
    root = np.linalg.cholesky(of_pose_alone(products.heads))
    by_pose = np.swapaxes(root, 1, 2) @ products.heads[:, :6]
    explained = np.swapaxes(by_pose[:, :, :head], 1, 2) @ by_pose
    posed, last = by_pose[:, :, head:-1], by_pose[:, :, -1]
    of_poses = Products(
        view, np.full(len(counts), 6.0), explained, np.zeros_like(products.functions),
        np.einsum("kar,ka->kr", posed, last), np.sum(last**2, axis=1), posed,
    )  # fmt: skip
    within = products.heads - explained
    # But for rounding, these are zero: noise within a view is orthogonal to its pose.
    within[:, :6], within[:, :, :6] = 0.0, 0.0
    rest = replace(
        products, counts=counts - 6.0, heads=within, pulls=products.pulls - of_poses.pulls,
        squares=products.squares - of_poses.squares, posed=posed, sign=-1.0,
    )  # fmt: skip
    return rest, of_poses


def of_pose_alone(heads: FloatArray) -> FloatArray:
    """(k, 6, 6) inverse information of (k, h, d + 1) products about their poses alone."""
    pose = heads[:, :6, :6]
    # Added to the information about a pose that corners leave open, over its diagonal.
    ridge = 1e-12 * (np.diagonal(pose, axis1=1, axis2=2) + np.ones(6))
    return np.asarray(np.linalg.inv(pose + ridge[:, :, None] * np.eye(6)), dtype=np.float64)


# Noise of poses that were measured by images (at a metre), by the rows that have it.
MEASURED_NOISES = (
    ("rad", slice(0, 2)), ("roll", slice(2, 3)), ("m", slice(3, 5)), ("depth", slice(5, 6)),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CornerRows:
    """Rows of n corners, by local columns."""

    head: FloatArray  # (n, 2, h) by pose, lens, board, delay and motion of the image's rows.
    functions: FloatArray  # (n, r) by a field, along either axis.
    residual: FloatArray  # (n, 2).
    local_columns: dict[Key, IntArray]  # Local columns of unknowns of one sighting.

    @property
    def count(self) -> int:
        """The number h of the head's columns."""
        return int(self.head.shape[2])


def corner_rows(
    unknowns: Unknowns, state: State, pair: Pair, poses: FloatArray, twists: FloatArray
) -> CornerRows:
    """The rows of all corners of a pair.

    At (k, 4, 4) `seer_from_seen` that move by (k, 6) `twists` per second.
    """
    seer, seen = pair.names
    lens, basis = unknowns.camera(state, seer), pair.basis[pair.ids]
    points = pair.points[pair.ids] + basis @ state.values["shape", seen]
    delays: dict[Key, FloatArray] = {
        ("effect", effect.name): effect.shares(pair.px)[:, None] * twists[pair.owner]
        for effect in unknowns.effects
        if isinstance(effect, Rolling) and effect.frame == seer
    }
    for key, moved in delays.items():
        points = apply_each(exp(state.values[key] * moved), points)
    corner_poses = poses[pair.owner]
    found = project_with_jacobian(lens, apply_each(corner_poses, points))
    by_point = found.jacobian_point @ corner_poses[:, :3, :3]
    columns: dict[Key, FloatArray] = {
        ("lens", seer): found.jacobian_intrinsics,
        ("shape", seen): by_point @ basis,
    }
    by_pose = np.concatenate([by_point @ -skew(points), by_point], axis=2)
    columns |= {key: by_pose @ moved[:, :, None] for key, moved in delays.items()}
    residual = pair.px - found.px
    for effect in unknowns.effects:
        if effect.frame != seer or effect.place == "edge" or isinstance(effect, Rolling):
            continue
        by_effect = found.jacobian_intrinsics
        if isinstance(effect, RowMotion):
            by_effect = columns["effect", effect.name] = effect.shifts(pair.px)
        if isinstance(effect, Displacement):
            seen_at = apply_each(corner_poses, points)
            by_effect = found.jacobian_point @ effect.moved(seen_at, corner_poses)
            columns["effect", effect.name] = by_effect
        columns_of = effect.columns(pair.moments, pair.distances(poses))
        moved = columns_of @ state.values["effect", effect.name]
        residual = residual - (by_effect @ moved[pair.owner, :, None])[:, :, 0]
    functions = np.zeros((len(residual), 0))
    if seer in unknowns.fields:
        # Where corners are predicted: at those seen, a field could explain their noise.
        functions = unknowns.fields[seer].functions(found.px)
        residual = residual - functions @ state.values["field", seer].reshape(2, -1).T
    head = np.concatenate([by_pose, *columns.values()], axis=2)
    # Corners behind the camera have no information.
    behind = ~(np.isfinite(head).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1))
    head[behind], functions[behind], residual[behind] = 0.0, 0.0, 0.0
    ends = 6 + np.cumsum([0, *(value.shape[2] for value in columns.values())])
    places = {key: np.arange(ends[at], ends[at + 1]) for at, key in enumerate(columns)}
    if functions.shape[1]:
        places["field", seer] = ends[-1] + np.arange(2 * functions.shape[1])
    weights = pair.weights[:, None]
    return CornerRows(head * weights[:, :, None], functions * weights, residual * weights, places)


def _measured_parts(
    unknowns: Unknowns, state: State, pair: Pair, poses: FloatArray
) -> tuple[tuple[Products, ...], dict[Key, IntArray]]:
    """Products of measured poses and places, and the local column of a board's size.

    Poses that were measured by images of a board that is larger by a share s than as stated have
    distances that are too short: those predicted are divided by 1 + s.
    """
    (seer, seen), rows = pair.names, np.zeros((len(pair.rows), 6, 8))
    first, size = pair.sightings[0].evidence, 1.0
    is_of_board = isinstance(first, MeasuredPose) and first.is_of_board
    place_m = first.sigma_m if isinstance(first, MeasuredPlace) else None
    if is_of_board:
        size += float(state.values["shape", seen][0])
    for at, (pose, sighting) in enumerate(zip(poses, pair.sightings, strict=True)):
        evidence = sighting.evidence
        if isinstance(evidence, MeasuredPose):
            found = compose(pose[:3, :3], pose[:3, 3] / size)
            residual = log(invert(found) @ evidence.matrix)
            by_size = np.append(np.zeros(3), -found[:3, :3].T @ found[:3, 3] / size)
            columns = np.column_stack([np.diag(np.repeat([1.0, 1.0 / size], 3)), by_size])
            rows[at] = np.column_stack([inverse_right_jacobian(-residual) @ columns, residual])
            rows[at] /= np.repeat([sigma or 1.0 for sigma in evidence.sigmas], 3)[:, None]
        elif isinstance(evidence, MeasuredPlace):
            rows[at, 3:, 3:6], rows[at, 3:, 7] = pose[:3, :3], evidence.place_m - pose[:3, 3]
            rows[at] /= evidence.sigma_m or 1.0
            rows[at, [3 + axis for axis in range(3) if axis not in evidence.axes]] = 0.0
    noises: Sequence[tuple[str, slice]] = MEASURED_NOISES
    if is_of_board:
        at_sight = [
            s.evidence.matrix for s in pair.sightings if isinstance(s.evidence, MeasuredPose)
        ]
        rows = sight_weights(np.array(at_sight), pair.middle) @ rows
    else:
        rows = np.delete(rows, 6, axis=2)
        sigmas = first.sigmas if isinstance(first, MeasuredPose) else (1.0, place_m)
        noises = [
            (name if sigma is None else "", slice(at, at + 3))
            for name, sigma, at in zip(("rad", "m"), sigmas, (0, 3), strict=True)
        ]
    parts = []
    for name, part_columns in noises:
        part = rows[:, part_columns]
        grams = np.swapaxes(part, 1, 2) @ part
        index = unknowns.size_of(f"{name} {seer}") if name else -1
        counts, squares = 1.0 * part.any(axis=2).sum(axis=1), grams[:, -1, -1]
        none, no_field = np.zeros((len(rows), 0)), np.zeros((len(rows), 0, 0))
        parts.append(Products(index, counts, grams[:, :-1], no_field, none, squares, no_field))
    return tuple(parts), {("shape", seen): np.arange(6, 7)} if is_of_board else {}


def sight_weights(poses: FloatArray, middle: FloatArray) -> FloatArray:
    """(k, 6, 6) factors of residuals of (k, 4, 4) measured poses, for noise of one size each.

    They are about a board's (3,) middle, in axes of which the last is along the sight. An image
    determines tilt and distance less surely than the turn about the line of sight and what is
    across it. The smaller the board is in it, the worse: the noise is that at a metre, from where
    it grows with the distance, and along the sight with its square. Both are of the poses as
    measured, so that noise does not depend on the unknowns.
    """
    places = apply(poses, middle[None])[:, 0]
    # One at no distance is wrong: it gets a millimetre.
    far = np.maximum(np.linalg.norm(places, axis=1), 1e-3)
    along = places / far[:, None]
    across = np.cross([0.0, 1.0, 0.0], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(along, across), along], axis=1) @ poses[:, :3, :3]
    weights = np.zeros((len(poses), 6, 6))
    weights[:, :3, :3] = weights[:, 3:, 3:] = axes
    weights /= (far[:, None] ** np.array([1, 1, 1, 1, 1, 2]))[:, :, None]
    return np.asarray(weights @ adjoint(invert(compose(np.eye(3), middle))))
