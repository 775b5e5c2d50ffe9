"""A fit: estimates with covariance, sightings left out, the budget, predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.fit.linearise import Gram, predicted
from visioncal.fit.mixed import Estimate, Mixed
from visioncal.fit.unknowns import Key, State, Unknowns
from visioncal.model import Cell, MeasuredPlace, Moments

# Added to information that determines nothing, over its diagonal.
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Deviation of each of n sightings from what all others predict, once its own rows are gone."""

    away: FloatArray  # (n, 6) as a right perturbation of `seer_from_seen`.
    predicted: FloatArray  # (n, 6, 6) covariance of the prediction.
    own: FloatArray  # (n, 6, 6) covariance of the sighting's own pose.
    directions: IntArray  # (n,) how many of the six it has: three last of a place.

    @cached_property
    def squares(self) -> FloatArray:
        """(n,) squared Mahalanobis lengths."""
        found = np.zeros(len(self.away))
        for count in np.unique(self.directions):
            rows = np.flatnonzero(self.directions == count)
            away = self.away[rows, 6 - count :]
            both = (self.predicted + self.own)[rows, 6 - count :, 6 - count :]
            found[rows] = np.sum(away * np.linalg.solve(both, away[:, :, None])[:, :, 0], axis=1)
        return found


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

    @cached_property
    def state(self) -> State:
        """The estimate."""
        return self.unknowns.moved(self.linearised, self.estimate.values, self.errors)

    @cached_property
    def errors(self) -> Mapping[str, FloatArray]:
        """(s, 6) by which each flange's errors differ from those of `linearised`."""
        found = {}
        for body, own in zip(self.mixed.bodies, self.estimate.bodies, strict=True):
            for place, name in enumerate(body.flanges):
                found[name] = np.zeros_like(self.linearised.errors[name])
                found[name][body.stops] = own.errors[:, 6 * place : 6 * place + 6]
        return found

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """Each size by its name."""
        values = np.exp(self.estimate.logs).tolist()
        return {size.name: at for size, at in zip(self.unknowns.sizes, values, strict=True)}

    @cached_property
    def whole(self) -> FloatArray:
        """(p, p) covariance of the unknowns, in units of their columns."""
        added = 0.0 if self.considered is None else self.considered
        return np.asarray(self.estimate.covariance + added)

    def edge(self, name: str) -> FloatArray:
        """(4, 4) `parent_from_frame`."""
        return self.state.values["edge", name]

    def camera(self, name: str) -> Camera:
        """A lens."""
        return self.unknowns.camera(self.state, name)

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
        """Leaves each used sighting out in turn; others are predicted as they are.

        Of rows with information H and gradient g about local columns of covariance C and estimate
        z, the estimate without them is (1 - C H)^-1 (z - C g), with covariance (1 - C H)^-1 C: it
        follows from the fit alone, nothing is fitted again (cf. Cook and Weisberg 1982, 2.2).
        """
        count = len(self.used)
        away, covariance, own = (
            np.zeros((count, 6)),
            np.zeros((count, 6, 6)),
            np.zeros((count, 6, 6)),
        )
        directions = np.full(count, 6)
        for gram in self.grams if grams is None else grams:
            places = [
                i for i in gram.rows if isinstance(self.cell.sightings[i].evidence, MeasuredPlace)
            ]
            directions[places] = 3
            at = gram.rows
            away[at], covariance[at], own[at] = self._left_out(gram)
        return LeftOut(away, covariance, own, directions)

    def _left_out(self, gram: Gram) -> tuple[FloatArray, FloatArray, FloatArray]:
        weighted, spread, f = (
            gram.weighted(self.estimate.logs),
            gram.spread(),
            6 * len(gram.flanges),
        )
        information, pull = weighted[:, :-1, :-1], weighted[:, :-1, -1]
        by_errors, by_columns = spread[:, :, :f], spread[:, :, f:]
        values = by_columns @ self.estimate.values[gram.columns]
        columns, jacobian = gram.columns, by_columns
        covariance = np.zeros_like(information)
        if f:
            at = next(i for i, b in enumerate(self.mixed.bodies) if gram.flanges[0] in b.flanges)
            body, solved = self.mixed.bodies[at], self.estimate.bodies[at]
            units = np.searchsorted(body.stops, gram.stops)
            places = [6 * body.flanges.index(name) + np.arange(6) for name in gram.flanges]
            own = np.concatenate(places)
            columns = body.columns
            jacobian = by_errors @ solved.response[units[:, None], own]
            jacobian[:, :, np.searchsorted(columns, gram.columns)] += by_columns
            errors = solved.own[units[:, None, None], own[:, None], own]
            covariance += by_errors @ errors @ np.swapaxes(by_errors, 1, 2)
            values = values + (by_errors @ solved.errors[units[:, None], own][:, :, None])[:, :, 0]
        common = self.estimate.covariance[columns[:, None], columns]
        covariance += jacobian @ common @ np.swapaxes(jacobian, 1, 2)
        part = self.used[gram.rows][:, None, None]
        without = np.linalg.inv(np.eye(gram.local) - part * covariance @ information)
        pulled = (covariance @ pull[:, :, None])[:, :, 0]
        values = (without @ (values - part[:, :, 0] * pulled)[:, :, None])[:, :, 0]
        covariance = without @ covariance
        # The pose that the sighting's rows alone have, given what else its rows depend on.
        pose = information[:, :6, :6]
        scale = np.maximum(np.trace(pose, axis1=1, axis2=2), 1.0)
        diagonal = np.diagonal(pose, axis1=1, axis2=2) + 1e-3 * scale[:, None]
        alone = np.linalg.inv(pose + _RIDGE * diagonal[:, :, None] * np.eye(6))
        other = alone @ information[:, :6, 6:]
        mapped = np.concatenate([np.tile(np.eye(6), (len(other), 1, 1)), other], axis=2)
        away = (alone @ pull[:, :6, None])[:, :, 0] - (mapped @ values[:, :, None])[:, :, 0]
        return away, mapped @ covariance @ np.swapaxes(mapped, 1, 2), alone

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
                sigmas = np.repeat([self.sizes[f"rad {name}"], self.sizes[f"m {name}"]], 3)
                noise += (slope * sigmas**2) @ np.swapaxes(slope, 1, 2)
        for effect in self.unknowns.effects:
            if effect.place == "edge" and effect.frame in at.slopes:
                columns = effect.columns(moments, np.ones(len(moments)))
                own = self.unknowns.columns("effect", effect.name)
                jacobian[:, :, own] += at.by_effects[effect.frame] @ columns
        calibration = jacobian @ self.whole @ np.swapaxes(jacobian, 1, 2)
        return Prediction(at.poses, jacobian, calibration, noise)

    def considering(self, added: FloatArray) -> "Fit":
        """The fit with more (p, p) covariance."""
        known = 0.0 if self.considered is None else self.considered
        return replace(self, considered=known + added)

    def seer_from_seen(self, row: int) -> FloatArray:
        """(4, 4) pose of a sighting as predicted at its own stop, with the errors of flanges."""
        sighting = self.cell.sightings[row]
        stop = np.array([sighting.stop])
        errors = {name: at[stop] for name, at in self.state.errors.items()}
        path, moments = self.cell.tree.path(*sighting.pair), self.cell.moments.take(stop)
        at = predicted(self.cell, self.unknowns, self.state, path, moments, errors)
        return np.asarray(at.poses[0])
