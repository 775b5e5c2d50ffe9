"""A sweep of a cell's only robot: frames of its camera, and no stops."""

from dataclasses import replace
from functools import partial

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.draws import RandomStream
from visioncal.simulation.layout import CellOptions
from visioncal.simulation.observing import simulate, with_detections
from visioncal.simulation.options import SweepOptions
from visioncal.simulation.passage import Passage

# A frame that shows less of the board gives no pose.
_FEWEST_CORNERS = 8


def sweep(options: CellOptions, how: SweepOptions | None = None) -> SimulatedCell:
    """Sweeps a cell's robot through as many of its stops as are asked for.

    Args:
        options: The cell; `views` is set by the sweep.
        how: How it is swept.

    Returns:
        The cell at the frames, each of them a view with its time; the controller's stream, by a
        clock of its own, is `robot`.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).robot.joints
    passage = Passage.through(stops, how)
    options = replace(options, views=len(passage.taken_s), wrong_views=0)
    frames = simulate(options, passage.way(passage.taken_s))
    if how.readout_s:
        frames = _by_rows(frames, passage)
    seen = [sight.view for sight in frames.sights if len(sight.exact.ids) >= _FEWEST_CORNERS]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = passage.taken_s[[frames.sights[index].stop for index in seen]]
    rng = options.stream(RandomStream.SWEEP)
    recorded = passage.reported(frames.robot.arm, rng)
    ahead_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    kept = frames.only(seen)
    sights = zip(kept.sights, (taken_s + ahead_s).tolist(), strict=True)
    return replace(
        kept,
        options=replace(options, views=len(seen)),
        sights=tuple(replace(sight, stamp_s=stamp_s) for sight, stamp_s in sights),
        streams={"robot": recorded},
        facts={"camera_minus_robot_s": how.camera_minus_robot_s, "readout_s": how.readout_s},
    )


def _by_rows(frames: SimulatedCell, passage: Passage) -> SimulatedCell:
    """The frames with every corner where it was when its row was taken."""
    robot = frames.robot
    jitter = invert(robot.flange_at(robot.joints)) @ robot.true_base_from_flange

    def taken(sight: SimulatedSight) -> SimulatedSight:
        seen_from = frames.seen_from("", sight.camera, sight.board)

        def before(off: FloatArray, q: FloatArray) -> FloatArray:
            return seen_from(robot.flange_at(q) @ off)

        exact = passage.frame(
            float(passage.taken_s[sight.stop]),
            partial(before, jitter[sight.stop]),
            frames.camera(),
            frames.board(sight.board),
            sight.view,
        )
        return replace(sight, exact=exact, at_once=False)

    return with_detections(replace(frames, sights=tuple(taken(sight) for sight in frames.sights)))
