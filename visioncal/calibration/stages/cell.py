"""A whole cell as its session has it: its frames, where its robots stood, who saw what."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.priors import priors_of
from visioncal.calibration.stages.reported_poses import Reported
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Mount
from visioncal.core.verdict import Remedy, or_alone
from visioncal.estimation.chain import edge_names
from visioncal.estimation.parts import FramePrior
from visioncal.estimation.tree import Branch, Tree
from visioncal.results import HELD_BACK
from visioncal.session import Observation, Session, frame_name
from visioncal.session.kinds import is_seen
from visioncal.session.selecting import is_whole_cell
from visioncal.session.tables import PriorTable

_CELL = "cell"


@dataclass(frozen=True, eq=False)
class ObservationRow:
    """An observation that can be used, of a place alone or of a pose."""

    view: int
    station: int
    seer: str
    seen: str
    is_place: bool


@dataclass(frozen=True, eq=False)
class Cell:
    """A session as a whole cell.

    Attributes:
        session: The session.
        tree: Its frames; the base of one robot, or one other frame, stands for the cell.
        reference: That frame.
        poses: (s, 4, 4) `base_from_flange` by robot and station; not a number where unknown.
        rows: The observations that can be used.
        reasons: Why others cannot, by view.
        stops: What the session calls each station: its stop's number, or its first view's.
        priors: Where frames were measured to be, beside the observations.
        held: The observations that could be used, and that the session keeps from every fit.
    """

    session: Session
    tree: Tree
    reference: str
    poses: Mapping[str, FloatArray]
    rows: tuple[ObservationRow, ...]
    reasons: Mapping[int, str] = field(default_factory=dict)
    stops: tuple[int, ...] = ()
    priors: tuple[FramePrior, ...] = ()
    held: tuple[ObservationRow, ...] = ()

    def from_when(self, station: int) -> str:
        """From when on, in the session's own numbers."""
        if "stop" in self.session.columns:
            return f"from stop {self.stops[station]} on"
        return f"from view {self.stops[station]} on"

    def or_apart(self, do: str, station: int) -> Remedy:
        """To do something and record again, or to calibrate the longer part of the session alone.

        Args:
            do: What to do, in the imperative.
            station: Where the later part begins.
        """
        parts: dict[str, list[int]] = {"before": [], "after": []}
        for row in (*self.rows, *self.held):
            parts["before" if row.station < station else "after"].append(row.view)
        where, views = max(parts.items(), key=lambda part: len(part[1]))
        words = f"{do}, and record again; or calibrate the {len(views)} views {where} it alone."
        either = or_alone(words, views)
        return either if either.command else Remedy(f"{do}, and record again.")

    @property
    def mount(self) -> Mount | None:
        """Where the camera of one camera and one robot is; None of a whole cell."""
        return None if is_whole_cell(self.session) else self.session.mount

    def without(self, reasons: Mapping[int, str]) -> "Cell":
        """Returns the cell without some views."""
        rows = tuple(row for row in self.rows if row.view not in reasons)
        return replace(self, rows=rows, reasons={**self.reasons, **reasons})

    def tied(self) -> tuple[str, ...]:
        """The frames that observations tie to the reference, in the tree's order."""
        names = [_CELL, *self.tree.branches]
        place = {name: at for at, name in enumerate(names)}
        pairs = [
            (place[name], place[branch.parent])
            for name, branch in self.tree.branches.items()
            if branch.known is not None
        ]
        pairs += [
            (place[prior.first], place[prior.second])
            for prior in self.priors
            if prior.matrix is not None
        ]
        for seer, seen in {(row.seer, row.seen) for row in self.rows}:
            ends = [seer, seen]
            for step in self.tree.path(seer, seen):
                if step.robot:
                    ends += [step.frame, self.tree.branches[step.frame].parent]
            pairs += [(place[seer], place[end]) for end in ends]
        links = coo_array(
            (np.ones(len(pairs)), np.array(pairs, dtype=np.int64).reshape(-1, 2).T),
            shape=(len(names), len(names)),
        )
        part = connected_components(links, directed=False)[1]
        return tuple(branch for branch in self.tree.branches if part[place[branch]] == part[0])

    def held_to(self, reference: str) -> "Cell":
        """Returns the cell in which one frame stands for it."""
        tree = self.tree.with_known(reference, np.eye(4))
        return replace(self, tree=tree, reference=reference)


def read_cell(seen: Observed) -> Cell:
    """Takes what was observed as a whole cell.

    Raises:
        DataError: It observes nothing, or what it says of its frames is not clear.
    """
    session = seen.timed
    frames = session.frames
    branches = {
        name: Branch(parent, robot=_robot_of(session, name)) for name, parent in frames.items()
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
            not is_seen(observation.view) and observation.view.instrument_from_probe() is None,
        )
        for observation in observations
        if _is_known(observation, seen.robots)
    ]
    held = tuple(row for row in rows if row.view in seen.held_back)
    rows = [row for row in rows if row.view not in seen.held_back]
    reasons = {**dict.fromkeys(seen.held_back, HELD_BACK), **seen.reasons, **seen.spared}
    stations: dict[int, int] = {}
    for observation in observations:
        number = observation.view.number if observation.view.stop is None else observation.view.stop
        stations.setdefault(observation.station, number)
    tree = Tree(_CELL, branches)
    priors = priors_of(_tables_of_priors(session, tree), tree)
    poses = _poses(seen, observations)
    cell = Cell(session, tree, "", poses, tuple(rows), reasons, priors=priors, held=held)
    cell = replace(cell, stops=tuple(stations[station] for station in sorted(stations)))
    return cell.held_to(_reference(cell))


def _tables_of_priors(session: Session, tree: Tree) -> dict[str, PriorTable]:
    """What is stated beforehand, by the full names of its frames."""
    # Of one camera and one robot that have no names, it is of an unknown edge, or not used. Where
    # they have names, flange and cam mean the only ones.
    tables = session.declaration.prior
    if not session.declaration.has_names:
        kept = {name: table for name, table in tables.items() if name in pair_edges(session)}
        of_probe = edge_names("instrument")[1]
        probe = next((branch for branch in tree.branches if branch.startswith("point")), "")
        if probe and of_probe in kept:
            kept[f"flange_from_{probe}"] = kept.pop(of_probe)
        return kept

    def full(frame: str) -> str:
        alike = [branch for branch in tree.branches if branch.startswith(f"{frame}_")]
        return alike[0] if frame not in tree.branches and len(alike) == 1 else frame

    return {"_from_".join(map(full, name.split("_from_"))): table for name, table in tables.items()}


def pair_edges(session: Session) -> tuple[str, ...]:
    """The names of the unknown edges of one camera and one robot, the camera's first."""
    camera, target = edge_names(session.mount)
    if session.mount == "instrument":
        return camera, target
    boards = tuple(session.targets) or ("",)
    parent = target.partition("_from_")[0]
    return (camera, *(f"{parent}_from_{frame_name('target', board)}" for board in boards))


def _robot_of(session: Session, frame: str) -> str:
    """The name that a flange's robot goes by, by its frame: two may not share an empty one."""
    for name in session.robots:
        if frame == frame_name("flange", name):
            return robot_key(name)
    return ""


def robot_key(name: str) -> str:
    """What a robot is called where every robot must have a name."""
    return name or "robot"


def _is_known(observation: Observation, robots: Mapping[str, Reported]) -> bool:
    """Whether it is known where all robots stood by way of which something was observed."""
    view = observation.view.number
    return not observation.lacks and all(
        view in robots[name].base_from_flange for name in observation.robots
    )


def _poses(seen: Observed, observations: Sequence[Observation]) -> dict[str, FloatArray]:
    """(s, 4, 4) where every robot stood at every station."""
    count = 1 + max(observation.station for observation in observations)
    poses = {robot_key(name): np.full((count, 4, 4), np.nan) for name in seen.robots}
    for observation in observations:
        for name, row in observation.robots.items():
            known = seen.robots[name].base_from_flange
            # What most rows of a stop say comes before what each says itself.
            at = row.number if row.number in known else observation.view.number
            if at in known:
                poses[robot_key(name)][observation.station] = known[at]
    return poses


def _reference(cell: Cell) -> str:
    """The frame that stands for the cell: the first base of most observations, or the like."""
    tree = cell.tree
    bases = [
        tree.branches[branch].parent for branch in tree.branches if tree.branches[branch].robot
    ]
    still = [name for name, branch in tree.branches.items() if branch.parent == _CELL]
    choices = [base for base in bases if base in still] or still

    def rows(name: str) -> int:
        tied = cell.held_to(name).tied()
        return sum(row.seer in tied for row in cell.rows)

    return max(choices, key=rows)
