"""Stops of a calibration that a later verification repeats: the robot has stood there."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from visioncal.core.conventions import PoseForm
from visioncal.core.documents.pendants import pendant_words
from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray, IntArray
from visioncal.results import Calibration
from visioncal.robot.errors import posture_features
from visioncal.session import Session
from visioncal.session.columns import POSE, pose_row


@dataclass(frozen=True, eq=False)
class CalibratedStops:
    """Some stops of a calibration."""

    views: tuple[int, ...]  # (k,) their first views.
    poses: FloatArray  # (k, 4, 4) `base_from_flange` [m].
    q: FloatArray | None  # (k, n) joint angles [rad]; None where not all were recorded.

    def table(self, form: PoseForm | None) -> str:
        """The stops as a table of poses and joint angles, by the views of the calibration.

        The poses are also in the maker's form, where it is known.
        """
        angles = np.zeros((len(self.views), 0)) if self.q is None else self.q
        joints = [f"q{index + 1}_rad" for index in range(angles.shape[1])]
        shown = [] if form is None else [f"pose_{form.name}"]
        rows: list[list[object]] = [["view", *joints, *POSE, *shown]]
        for view, q, pose in zip(self.views, angles, self.poses, strict=True):
            numbers = [*q.tolist(), *pose_row(pose).values()]
            words = [] if form is None else [pendant_words(pose, form)]
            rows.append([view, *(f"{number:.9f}" for number in numbers), *words])
        return csv_text(rows)


def stops_to_repeat(
    calibration: Calibration, session: Session | None, count: int
) -> CalibratedStops:
    """Chooses the calibrated stops with the widest spread of postures.

    Args:
        calibration: The calibration.
        session: Its session, which has the joint angles; None where it is not there.
        count: How many.

    Raises:
        DataError: The calibration does not say where its stops were.
    """
    stops = None if calibration.joint_fit is None else calibration.joint_fit.stops
    if stops is None:
        raise DataError(
            f"calibration {calibration.session_name!r} does not hold its stops "
            "(joint_fit.stops): it is of a whole cell, something moved, or an older version made "
            "it.",
            culprits=["--verify"],
            next_step="Calibrate its session again, or verify with new stops: visioncal plan.",
        )
    poses = exp(stops.poses)
    # Of several boards at one stop, the first.
    first = np.unique(stops.poses, axis=0, return_index=True)[1]
    rows = first[_spread_postures(poses[first], count)].tolist()
    views = tuple(stops.views[row] for row in rows)
    recorded = {} if session is None else {view.number: view for view in session.views}
    angles = [recorded[view].joints_rad for view in views if view in recorded]
    known = [q for q in angles if q is not None]
    return CalibratedStops(
        views, poses[rows], np.array(known) if len(known) == len(views) else None
    )


def _spread_postures(poses: FloatArray, count: int) -> IntArray:
    """(k,) indices of some of (s, 4, 4) postures, which are far apart.

    They are chosen by farthest-point clustering (Gonzalez 1985).
    """
    features = posture_features(poses)
    distance_sq = cdist(features, features, "sqeuclidean")
    chosen = [int(np.argmax(distance_sq.sum(axis=1)))]
    for _ in range(min(count, len(poses)) - 1):
        chosen.append(int(np.argmax(distance_sq[chosen].min(axis=0))))
    return np.array(chosen)
