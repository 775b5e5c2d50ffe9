"""A sweep of a single robot: camera frames during its motion, without stops."""

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
from visioncal.simulation.sweep_path import Passage

# Minimum number of corners for a pose.
_FEWEST_CORNERS = 8


def sweep(options: CellOptions, how: SweepOptions | None = None) -> SimulatedCell:
    """Simulates a sweep of a cell's robot.

    Args:
        options: The cell; `views` is set by the sweep.
        how: Options of the sweep.

    Returns:
        The cell at the frames, each of which is a view with a time; the controller's stream, with
        its own clock, is `robot`.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).robot.joints
    passage = Passage.through(stops, how)
    options = replace(options, views=len(passage.taken_s), wrong_views=0)
    frames = simulate(options, passage.path(passage.taken_s))
    if how.readout_s:
        frames = _rolling_shutter(frames, passage)
    seen = [sight.view for sight in frames.sights if len(sight.exact.ids) >= _FEWEST_CORNERS]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = passage.taken_s[[frames.sights[view].stop for view in seen]]
    rng = options.stream(RandomStream.SWEEP)
    recorded = passage.reported(frames.robot.arm, rng)
    offsets_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    kept = frames.only(seen)
    sights = zip(kept.sights, (taken_s + offsets_s).tolist(), strict=True)
    return replace(
        kept,
        options=replace(options, views=len(seen)),
        sights=tuple(replace(sight, stamp_s=stamp_s) for sight, stamp_s in sights),
        streams={"robot": recorded},
        facts={"camera_minus_robot_s": how.camera_minus_robot_s, "readout_s": how.readout_s},
    )


def _rolling_shutter(frames: SimulatedCell, passage: Passage) -> SimulatedCell:
    """The frames of a rolling shutter, with every corner at the time of its row."""
    robot = frames.robot
    jitter = invert(robot.flange_at(robot.joints)) @ robot.true_base_from_flange

    def rolled(sight: SimulatedSight) -> SimulatedSight:
        seen_from = frames.seen_from("", sight.camera, sight.board)

        def before(row_jitter: FloatArray, q: FloatArray) -> FloatArray:
            return seen_from(robot.flange_at(q) @ row_jitter)

        exact = passage.frame(
            float(passage.taken_s[sight.stop]),
            partial(before, jitter[sight.stop]),
            frames.camera(),
            frames.board(sight.board),
            sight.view,
        )
        return replace(sight, exact=exact, at_once=False)

    return with_detections(replace(frames, sights=tuple(rolled(sight) for sight in frames.sights)))
