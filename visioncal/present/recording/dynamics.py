"""Recording of a dynamic identification: the arm's motion and its torques over time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.blueprint import BlueprintLike

from visioncal.core.types import FloatArray
from visioncal.dynamics import Identified, Prediction, Run
from visioncal.present.recording import colours, paths
from visioncal.present.recording.notes import markdown, plain, table_lines
from visioncal.present.recording.scene import Scene, states_of
from visioncal.present.recording.writer import recording
from visioncal.present.torques import base_parameter_table, torque_table
from visioncal.present.words import said

# Size of the cell [m], by which axes are drawn.
_SIZE_M = 0.7
# Pause between motions [s], and the rate at which the arm is drawn [Hz].
_PAUSE_S, _DRAWN_HZ = 1.0, 20.0
_LINES = (
    (paths.MEASURED_TORQUE, colours.GRID, 2.5),
    (paths.KNOWN_TORQUE, colours.STATED, 1.0),
    (paths.PREDICTED_TORQUE, colours.USED, 1.2),
)


def write_dynamics_recording(path: Path, run: Run, blueprint: BlueprintLike | None = None) -> None:
    """Writes a session with its measured and predicted torques over time.

    Motions follow one another on the timeline.

    Args:
        path: The `.rrd` to write; it appears whole or not at all. `read_session` gives the session
            back.
        run: Identified model and its predictions.
        blueprint: Viewer layout of the recording.

    Raises:
        DataError: The file cannot be written, or an image of the session cannot be read.
    """
    with recording(path, run.session, blueprint) as recorder:
        stream, robot, start_s = recorder.stream, run.identified.robot, 0.0
        stream.reset_time()
        _log_static(stream, run.identified, run.predictions)
        for prediction in run.predictions:
            times_s = start_s + prediction.times_s - prediction.times_s[0]
            _log_series(stream, prediction, times_s)
            steps = np.floor((times_s - times_s[0]) * _DRAWN_HZ)
            drawn = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0.0)
            scene = Scene.planned(robot, states_of(robot, prediction.q[drawn]), _SIZE_M)
            scene.log_views(stream, dict(enumerate(times_s[drawn])), paths.MOTION_TIMELINE)
            recorder.keep()
            start_s = float(times_s[-1]) + _PAUSE_S


def _log_static(
    stream: rr.RecordingStream, identified: Identified, predictions: Sequence[Prediction]
) -> None:
    Scene.planned(identified.robot, {}, _SIZE_M).log_static(stream)
    has_known = any(prediction.known_nm is not None for prediction in predictions)
    for joint in range(identified.robot.joint_count):
        torque = paths.of_joint(paths.TORQUES, joint)
        for name, colour, width in _LINES:
            if name != paths.KNOWN_TORQUE or has_known:
                line = rr.SeriesLines(colors=[colour], widths=[width], names=[name])
                stream.log(f"{torque}/{name}", line, static=True)
        for group in (paths.TORQUE_ERRORS, paths.SPEEDS):
            line = rr.SeriesLines(names=[identified.robot.joint_names[joint]])
            stream.log(paths.of_joint(group, joint), line, static=True)
    lines = [f"## {plain(identified.robot.name)}: {identified.base.rank} base parameters"]
    lines += [
        *table_lines(torque_table(identified)),
        "",
        *map(plain, said("torque_note", identified)),
    ]
    for motion in identified.streams:
        for note in motion.notes:
            lines += ["", plain(note)]
    stream.log(paths.DYNAMICS_NOTE, markdown("\n".join(lines)), static=True)
    parameters = "\n".join(table_lines(base_parameter_table(identified)))
    stream.log(paths.PARAMETERS_NOTE, markdown(parameters), static=True)


def _log_series(stream: rr.RecordingStream, prediction: Prediction, times_s: FloatArray) -> None:
    # NaN ends the line, so that the next motion starts a new one.
    index = rr.TimeColumn(paths.MOTION_TIMELINE, duration=[*times_s, times_s[-1] + 0.5 * _PAUSE_S])
    lines = {
        paths.MEASURED_TORQUE: prediction.measured_nm,
        paths.PREDICTED_TORQUE: prediction.predicted_nm,
        paths.KNOWN_TORQUE: prediction.known_nm,
    }
    for joint in range(prediction.q.shape[1]):
        torque = paths.of_joint(paths.TORQUES, joint)
        columns = {
            f"{torque}/{name}": values[:, joint]
            for name, values in lines.items()
            if values is not None
        }
        columns[paths.of_joint(paths.TORQUE_ERRORS, joint)] = (
            prediction.measured_nm - prediction.predicted_nm
        )[:, joint]
        columns[paths.of_joint(paths.SPEEDS, joint)] = prediction.dq[:, joint]
        for entity, values in columns.items():
            scalars = rr.Scalars.columns(scalars=[*values, np.nan])
            stream.send_columns(entity, [index], scalars)
