"""Model of a whole cell read from a session: frames, robot poses, observations and priors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.priors import prior_of
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Mount
from visioncal.core.verdict import Remedy, or_alone
from visioncal.estimation.problem_parts import FramePrior
from visioncal.results import HELD_BACK
from visioncal.session import Observation, Session, View, frame_name
from visioncal.session.document import PriorTable
from visioncal.session.frames import edge_names
from visioncal.session.kinds import has_robot_state, is_camera_observation, name_of
from visioncal.session.tree import Branch, Tree

_CELL = "cell"


@dataclass(frozen=True, eq=False)
class ObservationRow:
    """A usable observation of a position alone or of a pose."""

    view: int
    station: int
    seer: str
    seen: str
    is_place: bool


@dataclass(frozen=True, eq=False)
class Cell:
    """A session as a whole cell."""

    session: Session  # The session.
    tree: Tree  # Tree of frames; the base of one robot, or one other frame, is the cell's frame.
    reference: str
    # (s, 4, 4) `base_from_flange` by robot and station; NaN where unknown.
    poses: Mapping[str, FloatArray]
    rows: tuple[ObservationRow, ...]  # The usable observations.
    # Why other views are not usable, by view.
    reasons: Mapping[int, str] = field(default_factory=dict)
    # Number of each station in the session: its stop, or its first view.
    stops: tuple[int, ...] = ()
    priors: tuple[FramePrior, ...] = ()  # Priors of frames.
    # Usable observations that the session holds back from every fit.
    held: tuple[ObservationRow, ...] = ()

    def start_words(self, station: int) -> str:
        """Start at a station in words, by the session's own numbers."""
        if "stop" in self.session.columns:
            return f"from stop {self.stops[station]} on"
        return f"from view {self.stops[station]} on"

    def views_from(self, station: int) -> list[int]:
        """The views from a station on."""
        return [row.view for row in (*self.rows, *self.held) if row.station >= station]

    def views_of_robot(self, robot: str, stop: int) -> list[int]:
        """The views with a robot's poses from a stop of the session on."""
        robot_views = (
            view
            for name in self.session.robots
            if robot_key(name) == robot
            for view in rows_of_robot(self.session, name)
        )
        return [view.number for view in robot_views if stop_of(view) >= stop]

    def or_separately(self, do: str, station: int, note: str = "") -> Remedy:
        """Advice to `do` something and record again, or to calibrate what follows it alone.

        Picks come after the session: what was before a station is no more. A note follows.
        """
        views = self.views_from(station)
        words = f"{do}, and record again; or calibrate the {len(views)} views after it alone{note}."
        either, plain = or_alone(words, views), f"{do}, and record again."
        return replace(either, plain=plain) if either.command else Remedy(plain)

    @property
    def mount(self) -> Mount | None:
        """Mount of the camera of a single camera and robot; None of a whole cell."""
        return self.session.mount if self.session.has_one_pair else None

    def without(self, reasons: Mapping[int, str]) -> "Cell":
        """Returns the cell without some views."""
        rows = tuple(row for row in self.rows if row.view not in reasons)
        return replace(self, rows=rows, reasons={**self.reasons, **reasons})

    def connected_frames(self) -> tuple[str, ...]:
        """The frames that observations connect to the reference, in the tree's order."""
        pairs = {
            (name, branch.parent)
            for name, branch in self.tree.branches.items()
            if branch.known is not None
        }
        pairs |= {(prior.first, prior.second) for prior in self.priors if prior.matrix is not None}
        for seer, seen in {(row.seer, row.seen) for row in self.rows}:
            ends = [seer, seen]
            for step in self.tree.path(seer, seen):
                if step.robot:
                    ends += [step.frame, self.tree.branches[step.frame].parent]
            pairs |= {(seer, end) for end in ends}
        connected = {_CELL}
        while (
            neighbours := {end for pair in pairs if connected & {*pair} for end in pair} - connected
        ):
            connected |= neighbours
        return tuple(branch for branch in self.tree.branches if branch in connected)

    def with_reference(self, reference: str) -> "Cell":
        """Returns the cell with a frame as its reference."""
        tree = self.tree.with_known(reference, np.eye(4))
        return replace(self, tree=tree, reference=reference)


def read_cell(seen: Observed) -> Cell:
    """Builds the cell from the observations of a session.

    Raises:
        DataError: The session has no observations, or its frames are ambiguous.
    """
    session = seen.timed
    # Robots by the frames of their flanges.
    flanges = {frame_name("flange", name): robot_key(name) for name in session.robots}
    branches = {
        name: Branch(parent, robot=flanges.get(name, "")) for name, parent in session.frames.items()
    }
    observations = [
        observation for observation in session.observations if not observation.view.is_of_lens
    ]
    if not observations:
        raise DataError(
            f"session {session.name!r}: no row has an observation of a camera or an instrument.",
            next_step="Give rows images and cameras, or poses in cft_ columns.",
        )
    rows = [
        ObservationRow(
            observation.view.number,
            observation.station,
            observation.seer,
            observation.seen,
            not is_camera_observation(observation.view)
            and observation.view.instrument_from_probe() is None,
        )
        for observation in observations
        # The poses of all robots between have to be known.
        if not observation.missing_robots
        and all(
            observation.view.number in seen.robots[name].base_from_flange
            for name in observation.robots
        )
    ]
    held = tuple(row for row in rows if row.view in seen.held_back)
    rows = [row for row in rows if row.view not in seen.held_back]
    reasons = {**dict.fromkeys(seen.held_back, HELD_BACK), **seen.reasons, **seen.spared}
    stations: dict[int, int] = {}
    for observation in observations:
        number = observation.view.number if observation.view.stop is None else observation.view.stop
        stations.setdefault(observation.station, number)
    tree = Tree(_CELL, branches)
    tables = _prior_tables(session, tree).items()
    priors = tuple(prior_of(name, table, tree) for name, table in tables)
    poses = _poses(seen, observations)
    cell = Cell(session, tree, "", poses, tuple(rows), reasons, priors=priors, held=held)
    cell = replace(cell, stops=tuple(stations[station] for station in sorted(stations)))
    return cell.with_reference(_reference(cell))


def _prior_tables(session: Session, tree: Tree) -> dict[str, PriorTable]:
    """The stated priors, by the full names of their frames."""
    # Of one camera and one robot without names, priors of the unknown edges are used. Where they
    # have names, flange and cam mean the only ones.
    tables = session.declaration.prior
    if not session.declaration.has_names:
        kept = {name: table for name, table in tables.items() if name in pair_edges(session)}
        of_probe = edge_names("instrument")[1]
        probe = next((branch for branch in tree.branches if branch.startswith("point")), "")
        if probe and of_probe in kept:
            kept[f"flange_from_{probe}"] = kept.pop(of_probe)
        return kept

    def full_name(frame: str) -> str:
        matches = [branch for branch in tree.branches if branch.startswith(f"{frame}_")]
        return matches[0] if frame not in tree.branches and len(matches) == 1 else frame

    return {
        "_from_".join(map(full_name, name.split("_from_"))): table for name, table in tables.items()
    }


def pair_edges(session: Session) -> tuple[str, ...]:
    """The names of the unknown edges of one camera and one robot, the camera's first."""
    camera, target = edge_names(session.mount)
    if session.mount == "instrument":
        return camera, target
    boards = tuple(session.targets) or ("",)
    parent = target.partition("_from_")[0]
    return (camera, *(f"{parent}_from_{frame_name('target', board)}" for board in boards))


def stop_of(view: View) -> int:
    """Number of a row's stop: its own where the table has no stops."""
    return view.number if view.stop is None else view.stop


def stops_by_view(session: Session) -> dict[int, int]:
    """Number of each row's stop, by its view; see `stop_of`."""
    return {view.number: stop_of(view) for view in session.views}


def rows_of_robot(session: Session, robot: str) -> list[View]:
    """The rows with the state of a robot, by its name in a session."""
    declaration = session.declaration
    return [
        view
        for view in session.views
        if has_robot_state(view) and name_of(declaration, "robot", view) == robot
    ]


def robot_key(name: str) -> str:
    """Name of a robot where none may be empty."""
    return name or "robot"


def _poses(seen: Observed, observations: Sequence[Observation]) -> dict[str, FloatArray]:
    """Pose (s, 4, 4) of every robot at every station; NaN where unknown."""
    count = 1 + max(observation.station for observation in observations)
    poses = {robot_key(name): np.full((count, 4, 4), np.nan) for name in seen.robots}
    # Stations of copies alone have none: errors of the arm are those of stops that were observed.
    for observation in observations:
        if observation.view.number in seen.repeats:
            continue
        for name, row in observation.robots.items():
            reported = seen.robots[name].base_from_flange
            # The stop's row, which most of its rows agree with, precedes the view's own.
            view = row.number if row.number in reported else observation.view.number
            if view in reported:
                poses[robot_key(name)][observation.station] = reported[view]
    return poses


def _reference(cell: Cell) -> str:
    """Reference frame: the base, or other static frame, that connects most observations."""
    tree = cell.tree
    bases = [
        tree.branches[branch].parent for branch in tree.branches if tree.branches[branch].robot
    ]
    still = [name for name, branch in tree.branches.items() if branch.parent == _CELL]
    choices = [base for base in bases if base in still] or still

    def connected_rows(name: str) -> int:
        connected = cell.with_reference(name).connected_frames()
        return sum(row.seer in connected for row in cell.rows)

    return max(choices, key=connected_rows)
