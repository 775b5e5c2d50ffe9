"""A fit: estimates with covariance, sightings left out, predictions."""

from collections.abc import Iterable, Mapping, Sequence
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

# `away`, `predicted` and `measured` of some sightings.
_Deviation: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Deviation of each of n sightings from what all others predict, once its own pose is gone."""

    away: FloatArray  # (n, 6) as a right perturbation of `seer_from_seen`.
    predicted: FloatArray  # (n, 6, 6) covariance of the prediction.
    measured: FloatArray  # (n, 6, 6) covariance of the pose by the sighting itself.
    directions: IntArray  # (n,) how many of the six it has; in others its covariance is large.

    @classmethod
    def of(cls, cell: Cell, found: Iterable[tuple[IntArray, _Deviation]]) -> Self:
        """Deviations of n sightings, given for some rows at a time; zeros for absent rows."""
        count = len(cell.sightings)
        away, predicted, measured = (np.zeros((count, *shape)) for shape in ((6,), (6, 6), (6, 6)))
        for rows, values in found:
            away[rows], predicted[rows], measured[rows] = values
        directions = np.array([sighting.directions for sighting in cell.sightings], np.int64)
        return cls(away, predicted, measured, directions)

    @cached_property
    def squares(self) -> FloatArray:
        """(n,) squared Mahalanobis lengths."""
        solved = np.linalg.solve(self.predicted + self.measured, self.away[:, :, None])[:, :, 0]
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
        for body, solved in zip(self.mixed.bodies, self.estimate.bodies, strict=True):
            errors = solved.errors + solved.response @ self.moved_by[body.columns]
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

    @cached_property
    def used_heads(self) -> tuple[tuple[Gram, FloatArray], ...]:
        """The sightings in use, with their `Gram.heads` at the estimate."""
        kept = [(gram, self.used[gram.rows]) for gram in self.grams]
        used = (gram if mask.all() else gram.take(mask) for gram, mask in kept if mask.any())
        return tuple((gram, gram.heads(self.estimate.logs)) for gram in used)

    def edge(self, name: str) -> FloatArray:
        """(4, 4) `parent_from_frame`."""
        return self.state.values["edge", name]

    def camera(self, name: str) -> Camera:
        """A lens alone, without its field: what matrix and distortion explain best.

        A stated lens is as far from itself as these explain of its field, over the image: beyond
        the corners, where its field fades, distortion that these alone determine would grow.
        """
        values, field = self.state.values["lens", name], self.unknowns.fields.get(name)
        if field is not None and field.instead is None:
            lens = self.unknowns.camera(self.state, name)
            axes = (np.linspace(0.0, side - 1.0, 33) for side in lens.resolution)
            by_field = field.orthogonal_to(
                lens, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
            ).instead
            if by_field is not None:
                values = values + by_field @ self.state.values["field", name]
        return with_intrinsics(self.unknowns.lenses[name], values)

    def covariance(self, *keys: Key) -> FloatArray:
        """Joint covariance of some unknowns, in SI units or pixels: of edges, 6 x 6 blocks."""
        at = np.concatenate([self.unknowns.columns(*key) for key in keys])
        units = self.unknowns.units[at]
        return np.asarray(self.whole[at[:, None], at] * np.outer(units, units))

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
        measured, mapped = _sighting_poses(heads)
        by_unknowns = gram.by_unknowns(mapped)
        columns, by_errors, jacobian = gram.columns, by_unknowns[:, :, :f], by_unknowns[:, :, f:]
        values = jacobian @ self.estimate.values[columns]
        covariance = np.zeros_like(measured)
        if f:
            at = body_with(self.mixed.bodies, gram.flanges)
            body, solved = self.mixed.bodies[at], self.estimate.bodies[at]
            units, places = np.searchsorted(body.stops, gram.stops), body.errors_of(gram.flanges)
            through = by_errors @ solved.response[units[:, None], places]
            through[:, :, np.searchsorted(body.columns, columns)] += jacobian
            columns, jacobian = body.columns, through
            errors = solved.covariance[units[:, None, None], places[:, None], places]
            covariance = by_errors @ errors @ np.swapaxes(by_errors, 1, 2)
            values += (by_errors @ solved.errors[units[:, None], places][:, :, None])[:, :, 0]
        common = self.estimate.covariance[columns[:, None], columns]
        covariance = covariance + jacobian @ common @ np.swapaxes(jacobian, 1, 2)
        part = self.used[gram.rows][:, None, None]
        measured_step = measured @ heads[:, :6, -1, None]
        share = part * np.linalg.solve(measured, covariance).swapaxes(1, 2)
        rest, known = np.eye(6) - share, values[:, :, None]
        away = measured_step - np.linalg.solve(rest, known - share @ measured_step)
        return away[:, :, 0], np.asarray(np.linalg.solve(rest, covariance), dtype=float), measured

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
                effect_columns = self.unknowns.columns("effect", effect.name)
                jacobian[:, :, effect_columns] += at.by_effects[effect.frame] @ columns
        calibration = jacobian @ self.whole @ np.swapaxes(jacobian, 1, 2)
        return Prediction(at.poses, jacobian, calibration, noise)

    def considering(self, added: FloatArray, shift: FloatArray | None = None) -> "Fit":
        """The fit with more (p, p) covariance, and an estimate shifted by (p,)."""
        known = 0.0 if self.considered is None else self.considered
        moved = self.moved_by + (0.0 if shift is None else shift)
        return replace(self, considered=known + added, shift=moved)


def _sighting_poses(heads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses by (k, h, d + 1) products of k sightings' own rows, given what else these depend on.

    Returns:
        Their (k, 6, 6) covariance, and (k, 6, d) derivatives by local columns.
    """
    information = heads[:, :6, :-1]
    pose = information[:, :, :6]
    scale = np.maximum(np.trace(pose, axis1=1, axis2=2), 1.0)
    diagonal = np.diagonal(pose, axis1=1, axis2=2) + 1e-3 * scale[:, None]
    # Added to information that determines nothing, over its diagonal.
    covariance = np.linalg.inv(pose + 1e-9 * diagonal[:, :, None] * np.eye(6))
    other = covariance @ information[:, :, 6:]
    return covariance, np.concatenate([np.tile(np.eye(6), (len(other), 1, 1)), other], axis=2)
