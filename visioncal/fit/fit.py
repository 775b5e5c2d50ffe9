"""A fit: estimates with covariance, sightings left out, the budget, predictions."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np

from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.fit.linearise import Gram, predicted
from visioncal.fit.mixed import Estimate, Mixed, body_with
from visioncal.fit.unknowns import Key, State, Unknowns
from visioncal.model import Cell, Moments
from visioncal.vision.camera import with_intrinsics

# Added to information that determines nothing, over its diagonal.
_RIDGE = 1e-9


# `away`, `predicted` and `own` of some sightings.
_Deviation: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Deviation of each of n sightings from what all others predict, once its own pose is gone."""

    away: FloatArray  # (n, 6) as a right perturbation of `seer_from_seen`.
    predicted: FloatArray  # (n, 6, 6) covariance of the prediction.
    own: FloatArray  # (n, 6, 6) covariance of the sighting's own pose.
    directions: IntArray  # (n,) how many of the six it has; in others its covariance is large.

    @classmethod
    def of(cls, cell: Cell, found: Iterable[tuple[IntArray, _Deviation]]) -> Self:
        """Those of a cell's n sightings, of some rows at a time; zeros of rows that are absent."""
        count = len(cell.sightings)
        away, predicted, own = (np.zeros((count, *shape)) for shape in ((6,), (6, 6), (6, 6)))
        for rows, values in found:
            away[rows], predicted[rows], own[rows] = values
        directions = np.array([sighting.directions for sighting in cell.sightings], np.int64)
        return cls(away, predicted, own, directions)

    @cached_property
    def squares(self) -> FloatArray:
        """(n,) squared Mahalanobis lengths."""
        solved = np.linalg.solve(self.predicted + self.own, self.away[:, :, None])[:, :, 0]
        return np.asarray(np.sum(self.away * solved, axis=1))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where one frame will be in another, at k moments."""

    poses: FloatArray  # (k, 4, 4) `seer_from_seen`.
    jacobian: FloatArray  # (k, 6, p) of right perturbations, by the unknowns.
    calibration: FloatArray  # (k, 6, 6) covariance by what the fit left open.
    noise: FloatArray  # (k, 6, 6) covariance by what the flanges err by at one stop.


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit of the used sightings of a cell."""

    cell: Cell
    unknowns: Unknowns
    linearised: State  # Where the sightings were linearised.
    grams: tuple[Gram, ...]  # All sightings, used or not.
    used: Mask  # (n,)
    mixed: Mixed
    estimate: Estimate
    # (p, p) covariance by errors that are considered, but not estimated; None where none are.
    considered: FloatArray | None = None
    # (p,) by which they move the estimate; None where they do not.
    shift: FloatArray | None = None

    @cached_property
    def state(self) -> State:
        """The estimate."""
        step = self.estimate.values + self.moved_by
        return self.unknowns.moved(self.linearised, step, self.errors)

    @property
    def moved_by(self) -> FloatArray:
        """(p,) the `shift`."""
        return np.zeros(self.unknowns.count) if self.shift is None else self.shift

    @cached_property
    def errors(self) -> Mapping[str, FloatArray]:
        """(s, 6) by which each flange's errors differ from those of `linearised`."""
        found = {}
        for body, own in zip(self.mixed.bodies, self.estimate.bodies, strict=True):
            errors = own.errors + own.response @ self.moved_by[body.columns]
            for place, name in enumerate(body.flanges):
                found[name] = np.zeros_like(self.linearised.errors[name])
                found[name][body.stops] = errors[:, 6 * place : 6 * place + 6]
        return found

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """Each size by its name."""
        values = np.exp(self.estimate.logs).tolist()
        return {size.name: at for size, at in zip(self.unknowns.sizes, values, strict=True)}

    def flange_sigmas(self, flange: str) -> FloatArray:
        """(6,) standard deviations of what a flange errs by at one stop [rad, m]."""
        return np.repeat([self.sizes[f"rad {flange}"], self.sizes[f"m {flange}"]], 3)

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom by which the flanges' noise is known."""
        stops = len({self.cell.sightings[at].stop for at in np.flatnonzero(self.used)})
        return max(6.0 * stops - self.unknowns.count / 2, 6.0)

    @cached_property
    def of_corners(self) -> float:
        """Degrees of freedom by which the corners' noise is known."""
        corners = (self.cell.sightings[at].corners for at in np.flatnonzero(self.used))
        rows = sum(2.0 * len(at.ids) - 6.0 for at in corners if at is not None)
        return max(rows - self.unknowns.count, 6.0)

    @cached_property
    def whole(self) -> FloatArray:
        """(p, p) covariance of the unknowns, in units of their columns."""
        added = 0.0 if self.considered is None else self.considered
        return np.asarray(self.estimate.covariance + added)

    def edge(self, name: str) -> FloatArray:
        """(4, 4) `parent_from_frame`."""
        return self.state.values["edge", name]

    def camera(self, name: str) -> Camera:
        """A lens alone, without its field: what matrix and distortion explain best.

        A stated lens is as far from itself as they explain of its field, over the image: beyond the
        corners, where its field fades, distortion that these alone determine would grow.
        """
        values, field = self.state.values["lens", name], self.unknowns.fields.get(name)
        if field is not None and field.instead is None:
            lens = self.unknowns.camera(self.state, name)
            axes = (np.linspace(0.0, side - 1.0, 33) for side in lens.resolution)
            own = field.beside(lens, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)).instead
            if own is not None:
                values = values + own @ self.state.values["field", name]
        return with_intrinsics(self.unknowns.lenses[name], values)

    def covariance(self, *keys: Key) -> FloatArray:
        """Joint covariance of some unknowns, in SI units or pixels: of edges, 6 x 6 blocks."""
        at = np.concatenate([self.unknowns.columns(*key) for key in keys])
        units = self.unknowns.units[at]
        return np.asarray(self.whole[at[:, None], at] * np.outer(units, units))

    def budget(self, key: Key) -> Mapping[str, FloatArray]:
        """Covariance of an unknown by what it is due to: each size's rows, and `stated` values."""
        at = self.unknowns.slices[key]
        units, found = self.unknowns.units[at], dict[str, FloatArray]()
        for size, share in self.mixed.shares(self.estimate):
            cause = self.unknowns.sizes[size].name if size >= 0 else "stated"
            found[cause] = share[at, at] * np.outer(units, units)
        if self.considered is not None:
            found["considered"] = self.considered[at, at] * np.outer(units, units)
        return found

    def left_out(self, grams: Sequence[Gram] | None = None) -> LeftOut:
        """Leaves the pose of each used sighting out in turn; others are predicted as they are.

        Its corners say of lens, board and field what they say beside a pose of their own. Of a pose
        that its rows alone determine as z with covariance A, and the fit as x with C, the estimate
        without it is (1 - C / A)^-1 (x - C / A z), with covariance (1 - C / A)^-1 C: it follows
        from the fit alone, nothing is fitted again (cf. Cook and Weisberg 1982, 2.2).
        """
        some = self.grams if grams is None else grams
        return LeftOut.of(self.cell, ((gram.rows, self._left_out(gram)) for gram in some))

    def _left_out(self, gram: Gram) -> _Deviation:
        heads, f = gram.heads(self.estimate.logs), 6 * len(gram.flanges)
        alone, mapped = _alone(heads)
        by_unknowns = gram.by_unknowns(mapped)
        columns, by_errors, jacobian = gram.columns, by_unknowns[:, :, :f], by_unknowns[:, :, f:]
        values = jacobian @ self.estimate.values[columns]
        covariance = np.zeros_like(alone)
        if f:
            at = body_with(self.mixed.bodies, gram.flanges)
            body, solved = self.mixed.bodies[at], self.estimate.bodies[at]
            units, own = np.searchsorted(body.stops, gram.stops), body.errors_of(gram.flanges)
            through = by_errors @ solved.response[units[:, None], own]
            through[:, :, np.searchsorted(body.columns, columns)] += jacobian
            columns, jacobian = body.columns, through
            errors = solved.own[units[:, None, None], own[:, None], own]
            covariance = by_errors @ errors @ np.swapaxes(by_errors, 1, 2)
            values += (by_errors @ solved.errors[units[:, None], own][:, :, None])[:, :, 0]
        common = self.estimate.covariance[columns[:, None], columns]
        covariance = covariance + jacobian @ common @ np.swapaxes(jacobian, 1, 2)
        part = self.used[gram.rows][:, None, None]
        own_pose = alone @ heads[:, :6, -1, None]
        share = part * np.linalg.solve(alone, covariance).swapaxes(1, 2)
        rest, known = np.eye(6) - share, values[:, :, None]
        away = own_pose - np.linalg.solve(rest, known - share @ own_pose)
        return away[:, :, 0], np.asarray(np.linalg.solve(rest, covariance), dtype=float), alone

    def stops_left_out(self) -> LeftOut:
        """Leaves each stop out in turn: no sighting at a stop predicts the others there.

        As `left_out`, but that all poses at a stop are removed at once from the information about
        common unknowns, and its flanges err by the noise that all others determine.
        """
        return LeftOut.of(self.cell, self._by_stop())

    def _by_stop(self) -> Iterator[tuple[IntArray, _Deviation]]:
        seen = dict[int, list[tuple[int, int]]]()
        heads = [gram.heads(self.estimate.logs) for gram in self.grams]
        for index, gram in enumerate(self.grams):
            for row, stop in enumerate(gram.stops.tolist()):
                seen.setdefault(stop, []).append((index, row))
        for stop, sightings in seen.items():
            columns = np.unique(np.concatenate([self.grams[at].columns for at, _ in sightings]))
            added = np.zeros((len(columns) + 1, len(columns) + 1))
            for at, row in sightings:
                gram = self.grams[at].take(np.arange(len(self.grams[at].rows)) == row)
                if self.used[gram.rows[0]]:
                    _, mapped = _alone(own_heads := heads[at][row : row + 1])
                    own = np.append(np.searchsorted(columns, gram.columns), len(columns))
                    by_pose, f = gram.by_unknowns(mapped)[0], 6 * len(gram.flanges)
                    of_pose = gram.by_unknowns(own_heads[:, :6, :-1])[0, :, f:]
                    rows = np.column_stack([of_pose, own_heads[0, :6, -1]])
                    added[own[:-1, None], own] += by_pose[:, f:].T @ rows
            values, covariance = self._without_stop(stop, columns, added)
            for at, row in sightings:
                gram = self.grams[at].take(np.arange(len(self.grams[at].rows)) == row)
                own = np.searchsorted(columns, gram.columns)
                none = np.zeros(0)
                sigmas = np.concatenate([none, *map(self.flange_sigmas, gram.flanges)])
                past = [-self.linearised.errors[name][stop] for name in gram.flanges]
                alone, mapped = _alone(own_heads := heads[at][row : row + 1])
                both, f = gram.by_unknowns(mapped), 6 * len(gram.flanges)
                by_errors, by_columns = both[:, :, :f], both[:, :, f:]
                predicted = by_columns @ values[own] + by_errors @ np.concatenate([none, *past])
                by_all = by_columns @ covariance[own[:, None], own] @ by_columns.swapaxes(1, 2)
                within = (by_errors * sigmas**2) @ by_errors.swapaxes(1, 2) + by_all
                away = (alone @ own_heads[:, :6, -1, None])[:, :, 0] - predicted
                yield gram.rows, (away, within, alone)

    def _without_stop(
        self, stop: int, columns: IntArray, added: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Estimate (c,) and covariance (c, c) of columns without the rows at a stop.

        Args:
            stop: The stop.
            columns: (c,) all on which its sightings depend.
            added: (c + 1, c + 1) Gram matrix of its used sightings by these, and the residual.
        """
        for body, solved in zip(self.mixed.bodies, self.estimate.bodies, strict=True):
            unit = int(np.searchsorted(body.stops, stop))
            if unit == len(body.stops) or body.stops[unit] != stop:
                continue
            at = np.isin(body.columns, columns)
            own = np.append(np.searchsorted(columns, body.columns[at]), len(columns))
            # By errors at zero of the unknowns.
            response = solved.response[unit]
            none = solved.errors[unit] - response @ self.estimate.values[body.columns]
            by = np.column_stack([-response[:, at], none])
            added[own[:, None], own] -= by.T @ np.linalg.solve(solved.own[unit], by)
        covariance = self.estimate.covariance[columns[:, None], columns]
        values = self.estimate.values[columns] - covariance @ added[:-1, -1]
        without = np.linalg.inv(np.eye(len(columns)) - covariance @ added[:-1, :-1])
        return without @ values, without @ covariance

    def predict(self, seer: str, seen: str, moments: Moments) -> Prediction:
        """Predicts where a frame will be in another, with covariance.

        Args:
            seer: The frame in which it is.
            seen: The frame that is predicted.
            moments: The k moments.
        """
        path = self.cell.tree.path(seer, seen)
        at = predicted(self.cell, self.unknowns, self.state, path, moments, {})
        jacobian = np.zeros((len(moments), 6, self.unknowns.count))
        noise = np.zeros((len(moments), 6, 6))
        for name, slope in at.slopes.items():
            if ("edge", name) in self.unknowns:
                jacobian[:, :, self.unknowns.columns("edge", name)] += slope
            if name in self.unknowns.erring:
                noise += (slope * self.flange_sigmas(name) ** 2) @ np.swapaxes(slope, 1, 2)
        for effect in self.unknowns.effects:
            if effect.place == "edge" and effect.frame in at.slopes:
                values = self.state.values["effect", effect.name]
                columns = effect.slopes(moments, values)
                own = self.unknowns.columns("effect", effect.name)
                jacobian[:, :, own] += at.by_effects[effect.frame] @ columns
        calibration = jacobian @ self.whole @ np.swapaxes(jacobian, 1, 2)
        return Prediction(at.poses, jacobian, calibration, noise)

    def considering(self, added: FloatArray, shift: FloatArray | None = None) -> "Fit":
        """The fit with more (p, p) covariance, and an estimate shifted by (p,)."""
        known = 0.0 if self.considered is None else self.considered
        moved = self.moved_by + (0.0 if shift is None else shift)
        return replace(self, considered=known + added, shift=moved)


def _alone(heads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses by (k, h, d + 1) products of k sightings' own rows, given what else these depend on.

    Returns:
        Their (k, 6, 6) covariance, and (k, 6, d) derivatives by local columns.
    """
    information = heads[:, :6, :-1]
    pose = information[:, :, :6]
    scale = np.maximum(np.trace(pose, axis1=1, axis2=2), 1.0)
    diagonal = np.diagonal(pose, axis1=1, axis2=2) + 1e-3 * scale[:, None]
    alone = np.linalg.inv(pose + _RIDGE * diagonal[:, :, None] * np.eye(6))
    other = alone @ information[:, :, 6:]
    return alone, np.concatenate([np.tile(np.eye(6), (len(other), 1, 1)), other], axis=2)
