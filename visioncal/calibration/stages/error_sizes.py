"""Sizes of the errors of lenses and boards, by the one likelihood of a session; see `fit`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.types import Camera, Corners, FloatArray
from visioncal.estimation.outliers import EARLY_SHARE
from visioncal.estimation.scene import BoardSizes
from visioncal.fit.fit import Fit
from visioncal.fit.held import doubted_boards
from visioncal.fit.linearise import MEASURED_NOISES, sight_weights
from visioncal.fit.sizes import most_likely
from visioncal.fit.solve import CellFit, solve_from
from visioncal.fit.start import Start, start_of
from visioncal.fit.unknowns import Key
from visioncal.model import MeasuredPose, Reported, Swept, read_cell
from visioncal.model.boards import shape_order
from visioncal.model.effects import EFFECTS, Displacement, Effect, LensGrows, LensSteps, Named
from visioncal.model.effects.effect import LensEffect
from visioncal.session import frame_name
from visioncal.vision.camera import intrinsics, project, project_with_jacobian
from visioncal.vision.lens_field import LensLevels, lens_part
from visioncal.vision.targets import corner_positions, first_numbers


@dataclass(frozen=True, eq=False)
class FoundEffect:
    """An effect of a size that chance does not explain."""

    effect: LensEffect
    columns: FloatArray  # See `Effect.columns`, at the session's stations.
    values: FloatArray  # (c,) estimates.
    covariance: FloatArray  # (c, c) of these.
    gain: float  # Twice the gain in log-likelihood.


@dataclass(frozen=True, eq=False)
class OpenedEffect:
    """An effect on a flange of a size that chance does not explain."""

    effect: Effect
    size: float  # Standard deviation of its values.
    gain: float  # Twice the gain in log-likelihood.


@dataclass(frozen=True, eq=False)
class Displaced:
    """Displacements of what a camera sees, of a size that chance does not explain."""

    effect: Displacement
    columns: FloatArray  # (s, q, c) see `Effect.columns`, at the session's stations.
    values: FloatArray  # (c,) estimates.
    gain: float  # Twice the gain in log-likelihood.


@dataclass(frozen=True)
class Zoom:
    """A lens that changed, by more than one that warms up."""

    station: int | None  # The first after it changed at once; None where it crept.
    share: float  # Of the focal length by which it is longer from there on, or at the end.
    shift_px: tuple[float, float] = (0.0, 0.0)  # By which its centre is elsewhere from there on.
    kind: str = "lens grows"  # Of its effect.


@dataclass(frozen=True, eq=False)
class ErrorSizes:
    """Sizes of errors; none of a lens or a board that is absent."""

    levels: Mapping[str, LensLevels] = field(default_factory=dict)  # Beyond the model, by camera.
    # (k, k) covariances of given intrinsics beyond what is stated, by camera.
    lenses: Mapping[str, FloatArray] = field(default_factory=dict)
    boards: Mapping[str, BoardSizes] = field(default_factory=dict)  # By the session's name.
    grown: tuple[FoundEffect, ...] = ()  # Lenses that grow or sag.
    # Other lenses that changed, by camera: the fit has them as lenses that vary from view to view,
    # since what is linear at one lens is not so at another.
    zoomed: Mapping[str, Zoom] = field(default_factory=dict)
    opened: tuple[OpenedEffect, ...] = ()  # Those that findings name.
    displaced: tuple[Displaced, ...] = ()  # By panes before lenses, and boards that swell.
    rivals: Mapping[str, frozenset[str]] = field(default_factory=dict)  # See `Unknowns.rivals`.
    # Where a fit of poses starts: (s,) shapes of boards by frame, see `shape_basis`, and lenses.
    shapes: Mapping[str, FloatArray] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    def steadied(
        self,
        camera: str,
        station: int,
        corners: Corners,
        shown: tuple[Camera, FloatArray, FloatArray],
    ) -> Corners:
        """Corners of an image by a lens that neither grows nor sags, without displacements.

        Args:
            camera: The camera's frame.
            station: Where the robot stood; -1 where that is not known.
            corners: The corners.
            shown: About the lens, (4, 4) where it sees the board, and (n, 3) where them [m].
        """
        px, (lens_now, pose, seen) = corners.px, shown
        for at in self.displaced:
            if at.effect.frame == camera:
                moved = at.effect.moved(seen, pose) @ (at.columns[station] @ at.values)
                px = px + project(lens_now, seen) - project(lens_now, seen + moved)
        for found in self.grown:
            if found.effect.frame == camera and 0 <= station < len(found.columns):
                by_lens = project_with_jacobian(found.effect.lens, seen).jacobian_intrinsics
                px = px - by_lens @ (found.columns[station] @ found.values)
        return replace(corners, px=px)

    def steadied_by(self, kind: str, camera: str) -> FloatArray:
        """(c,) values of a kind of a problem's effects that `steadied` takes; (1,) zero of none."""
        camera_effects = (one for one in self.grown if one.effect.frame == camera)
        values = (one.values for one in camera_effects if one.effect.kind == kind.replace("_", " "))
        return next(values, np.zeros(1))

    def instead_of(self, kind: str) -> tuple[str, ...]:
        """The rivals of a kind of effects, as clauses."""
        return tuple(EFFECTS[rival].clause for rival in sorted(self.rivals.get(kind, ())))


def error_sizes(observed: Observed, solved: CellFit | None) -> ErrorSizes:
    """The sizes by the one likelihood of a session; none where it does not come to rest."""
    session = observed.timed
    if solved is None:
        # A fit without rest determines no board.
        return ErrorSizes(boards=dict.fromkeys(session.boards, BoardSizes(is_held=True)))
    fit, doubted = solved.fit, doubted_boards(solved.doubts)
    grown = tuple(_grown(fit))
    levels = {name: _levels(fit, name) for name in fit.unknowns.lenses}
    # Positive evidence (Kass and Raftery 1995, 3.2) frees boards, within what they may be off by;
    # but not where links may be as much longer.
    is_confounded = any(_size(fit, f"links {name}") for name in fit.cell.arms)
    holds = is_confounded or all(one.board_odds < np.log(3.0) for one in solved.doubts)
    boards = dict[str, BoardSizes]()
    for name, target in session.boards.items():
        key: Key = ("shape", session.board_frames[name])
        if key in fit.unknowns:
            scale, plane, bend = (_size(fit, f"{of} {key[1]}") for of in ("scale", "plane", "bend"))
            stated = target.square_sigma_m / target.square_m
            square = max(scale**2 - stated**2, doubted.get(key, 0.0))
            # A doubt within what is stated leaves the board as it is.
            beyond = float(np.sqrt(square)) if square > stated**2 else 0.0
            is_doubted = any(prior.considered > 0.0 for prior in fit.unknowns[key].priors)
            boards[name] = BoardSizes(beyond, plane, bend, is_held=is_doubted and holds)
    given = (name for name in levels if observed.cameras[name].table.stated is not None)
    lenses = {name: _covariance(fit, name, levels[name]) for name in given}
    lenses = {name: covariance for name, covariance in lenses.items() if covariance.any()}
    for found in grown:
        # In each view, the lens is another than on average.
        name = found.effect.frame
        focal_px = fit.unknowns.lenses[name].matrix[0]
        focal_jitter = (
            float(np.std(found.columns[:, 0] @ found.values)) / focal_px / _noise_px(fit, name)
        )
        jitter = float(np.hypot(levels[name].jitter, focal_jitter))
        levels[name] = replace(levels[name], jitter=jitter)
    zoomed, grew = dict[str, Zoom](), {at.effect.frame: abs(float(at.values[0])) for at in grown}
    for effect, zoom, rms in _changed(fit):
        name, others = effect.frame, levels[effect.frame]
        jitter = float(np.hypot(others.jitter, rms / _noise_px(fit, name)))
        gains = (*others.gains[:2], max(others.gains[2], _gain(fit, effect.name)), others.gains[3])
        levels[name] = replace(others, jitter=jitter, gains=gains)
        # A step beside a larger growth is what its course differs by.
        if abs(zoom.share) > grew.get(name, 0.0):
            zoomed[name], grew[name] = zoom, abs(zoom.share)
    displaced = tuple(_displaced(fit))
    known = _opened(fit), displaced, fit.unknowns.rivals
    shapes = {
        key[1]: values[np.argsort(shape_order(len(values)))]
        for key, values in fit.state.values.items()
        if key[0] == "shape"
    }
    cameras = {name: fit.camera(name) for name in fit.unknowns.lenses}
    return ErrorSizes(levels, lenses, boards, grown, zoomed, *known, shapes, cameras)


def scales_of(solved: CellFit | None) -> dict[str, float]:
    """Shares by which boards are larger than stated, by frame, by the one likelihood."""
    shapes = {} if solved is None else solved.fit.state.values
    return {key[1]: float(values[0]) for key, values in shapes.items() if key[0] == "shape"}


@dataclass(frozen=True, eq=False)
class MeasuredErrors:
    """Errors of boards' poses that a program measured in images; none where no fit converges."""

    # (6, 6) covariance about the target of each pose's residual, by view, with the noise of the
    # flange from stop to stop.
    noise: Mapping[int, FloatArray] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)  # Sigmas of scales, by frame.
    opened: tuple[OpenedEffect, ...] = ()  # See `ErrorSizes`.


def measured_errors(solved: CellFit | None) -> MeasuredErrors:
    """The errors of measured poses by the one likelihood of a session without images."""
    if solved is None:
        return MeasuredErrors()
    fit = solved.fit
    noise, sizes = dict[int, FloatArray](), dict[str, float]()
    of_flange = np.zeros((6, 6))
    for frame in fit.cell.arms:
        if f"rad {frame}" in fit.sizes:
            rad, metres = fit.sizes[f"rad {frame}"], fit.sizes[f"m {frame}"]
            of_flange += np.diag(np.repeat([rad, metres], 3) ** 2)
    for one in fit.cell.sightings:
        pose = one.evidence
        if not isinstance(pose, MeasuredPose) or not pose.is_of_board:
            continue
        if f"scale {one.seen}" in fit.sizes:
            sizes[one.seen] = fit.sizes[f"scale {one.seen}"]
        table = fit.cell.cameras.get(one.seer)
        if table is not None and table.scale_sigma is not None:
            sizes[one.seen] = table.scale_sigma
        sigmas = np.zeros(6)
        for name, rows in MEASURED_NOISES:
            sigmas[rows] = fit.sizes[f"{name} {one.seer}"]
        board = fit.cell.boards.get(one.seen)
        middle = np.zeros(3) if board is None else corner_positions(board).mean(axis=0)
        factor = np.linalg.inv(sight_weights(pose.matrix[None], middle)[0]) * sigmas
        noise[one.view] = factor @ factor.T + of_flange
    return MeasuredErrors(noise, sizes, _opened(fit))


def _opened(fit: Fit) -> tuple[OpenedEffect, ...]:
    """Effects on flanges that findings name."""
    found = list[OpenedEffect]()
    for at in fit.unknowns.opened:
        if isinstance(at, Named) and at.frame in fit.cell.arms and fit.sizes[at.name] <= at.most:
            # Without it, the flange's noise is another.
            low, high = fit.unknowns.closing({*fit.unknowns.closed, at.name}).bounds()
            without = most_likely(fit.mixed, np.clip(fit.estimate.logs, low, high), low, high)
            gain = without.estimate.value - fit.estimate.value
            if gain > at.size.limit:
                found.append(OpenedEffect(at, fit.sizes[at.name], gain))
    return tuple(found)


def solve_session(observed: Observed) -> CellFit:
    """The one likelihood of what is known of a session; raises what `solve` raises."""
    return solve_from(session_start(observed))


def session_start(observed: Observed, reference: str = "", *, has_priors: bool = True) -> Start:
    """Where the fit of a session starts: its lenses, frames, and the pose of each sighting.

    Args:
        observed: The observations.
        reference: The cell's own frame; see `model.read_cell`.
        has_priors: Whether what session.toml states of frames counts.
    """
    session, lenses = observed.timed, {name: at.camera for name, at in observed.lenses.items()}
    sweeps = [
        Swept(
            pair.camera,
            frame_name("flange", pair.robot),
            clocked.speeds,
            clocked.prior_sigma_s(erring=pair.robot in session.robot_documents),
        )
        for pair, clocked in observed.clocks.items()
        if clocked.speeds
    ]
    reports = dict[str, Reported]()
    for name, at in observed.robots.items():
        model = None if at.joints_rad is None or at.matched is None else at.matched.robot
        reports[name] = Reported(at.base_from_flange, at.joints_rad or {}, model)
    cell = read_cell(session, _own_corners(observed), sweeps, reports, reference)
    unused = {**observed.reasons, **observed.spared}
    rows = enumerate(cell.sightings)
    cell = cell.only(
        at for at, one in rows if one.view not in unused and (has_priors or not one.is_stated)
    )
    cameras = dict(cell.cameras)
    for name, table in cameras.items():
        # The fit of poses holds a lens; what it may be off by counts.
        other = replace(table, intrinsics="auto") if table.intrinsics == "hold" else table
        if name in observed.lenses and observed.lenses[name].estimated:
            # The stated one may be another camera's.
            other = replace(other, matrix=None, distortion=None)
        cameras[name] = other
    return start_of(replace(cell, cameras=cameras), lenses, EARLY_SHARE)


def _own_corners(observed: Observed) -> dict[int, Corners]:
    """The corners of the views that a fit may use, each numbered on its own board."""
    session, starts = observed.session, first_numbers(observed.session.boards)
    board_of = {view.number: session.board_of(view) for view in session.views}
    return {
        view: replace(corners, ids=corners.ids - starts[board_of[view]])
        for view, corners in observed.corners.items()
        if view not in observed.reasons and view not in observed.spared
    }


def _size(fit: Fit, name: str) -> float:
    """A size; zero where chance explains it."""
    return 0.0 if name in fit.unknowns.closed else fit.sizes.get(name, 0.0)


def _noise_px(fit: Fit, camera: str) -> float:
    """Noise of a corner's coordinate, as estimated or as stated [px]."""
    corner_sets = (one.corners for one in fit.cell.sightings if one.seer == camera)
    stated = [at.stated_px for at in corner_sets if at is not None and at.stated_px is not None]
    return fit.sizes.get(f"px {camera}") or float(np.median(stated))


def _levels(fit: Fit, camera: str) -> LensLevels:
    """Sizes of a lens's errors beyond its model, in units of the noise of its corners."""
    names = [f"{of} {camera}" for of in ("field", "breathing", "focus jitter", "row motion")]
    px, at = _noise_px(fit, camera), fit.unknowns.fields.get(camera)
    field_px, breathing, jitter, motion = (_size(fit, name) / px for name in names)
    of_field, of_breathing, of_jitter, of_motion = (_gain(fit, name) for name in names)
    gains = (of_field, of_breathing, of_jitter, of_motion)
    return LensLevels(field_px, at.length if at else 0.2, breathing, jitter, motion, gains)


def _grown(fit: Fit) -> Iterator[FoundEffect]:
    """Lenses that grow or sag by what they may."""
    stations, moments = np.array(fit.cell.stations), fit.cell.moments
    for effect in fit.unknowns.effects:
        if not isinstance(effect, LensEffect) or not isinstance(effect, Named):
            continue
        if not 0.0 < _size(fit, effect.name) <= effect.most:
            continue
        known = effect.columns(moments, np.ones(len(moments)))
        columns = np.zeros((stations.max() + 1, *known.shape[1:]))
        columns[stations] = np.nan_to_num(known)
        key: Key = ("effect", effect.name)
        estimate, covariance = fit.state.values[key], fit.covariance(key)
        yield FoundEffect(effect, columns, estimate, covariance, _gain(fit, effect.name))


def _displaced(fit: Fit) -> Iterator[Displaced]:
    """Displacements of what cameras see; where the robot's place is not known, as at the end."""
    stations, moments = np.array(fit.cell.stations), fit.cell.moments
    for effect in fit.unknowns.effects:
        if isinstance(effect, Displacement) and _size(fit, effect.name):
            known = effect.columns(moments, np.ones(len(moments)))
            columns = np.tile(known[-1], (stations.max() + 2, 1, 1))
            columns[stations] = known
            values = fit.state.values["effect", effect.name]
            yield Displaced(effect, columns, values, _gain(fit, effect.name))


def _changed(fit: Fit) -> Iterator[tuple[Effect, Zoom, float]]:
    """Lenses that changed at once or crept, and by which share of the focal length (rms)."""
    for effect in fit.unknowns.effects:
        size = _size(fit, effect.name)
        if isinstance(effect, LensSteps) and size:
            values = -fit.state.values["effect", effect.name]
            share, focal_px = float(values[0]), float(np.mean(effect.lens.matrix[:2]))
            shift_px = float(focal_px * values[1]), float(focal_px * values[2])
            stops = np.array([one.stop for one in fit.cell.sightings if one.seer == effect.frame])
            before = float(np.mean(stops < effect.stop))
            zoom = Zoom(fit.cell.stations[effect.stop], share, shift_px, effect.kind)
            yield effect, zoom, abs(share) * float(np.sqrt(before * (1.0 - before)))
        elif isinstance(effect, LensGrows) and size > effect.most:
            share = float(fit.state.values["effect", effect.name][0])
            yield effect, Zoom(None, share), abs(share) / 4.0


def _gain(fit: Fit, name: str) -> float:
    """Fall of twice the log-likelihood without what has a size."""
    if not _size(fit, name):
        return 0.0
    logs, at = fit.estimate.logs.copy(), fit.unknowns.size_of(name)
    logs[at] = fit.unknowns.bounds()[0][at]
    return float(fit.mixed.at(logs, is_sloped=False).value - fit.estimate.value)


def _covariance(fit: Fit, camera: str, levels: LensLevels) -> FloatArray:
    """(k, k) covariance of given intrinsics by their sizes; a field displaces by these, too."""
    lens = fit.unknowns.lenses[camera]
    sigmas = np.zeros(len(intrinsics(lens)))
    if ("lens", camera) in fit.unknowns:
        member = fit.unknowns["lens", camera]
        for prior in member.priors:
            if prior.size is not None:
                sigmas[prior.columns] = _size(fit, prior.size.name) * member.units[prior.columns]
    field_px = levels.field * _noise_px(fit, camera)
    by_field = field_px * lens_part(lens, levels.length)
    return np.asarray(np.diag(sigmas**2) + by_field @ by_field.T)
