"""Arms that warm up: their sessions calibrated, and what is left of their drift hours later."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.thermal import inputs_of
from visioncal.core.types import FloatArray
from visioncal.estimation.workspace import postures
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.robot.thermal import Inputs
from visioncal.session import Session
from visioncal.simulation import (
    CellOptions,
    SimulatedCell,
    WarmUpOptions,
    cell_session,
    simulate_warm_up,
)
from visioncal.simulation.arms import Heat, Warming, heated_poses
from visioncal.simulation.optics import fine_camera

# What 100 minutes are to predict: the rest of five hours [s].
TRAINED_S, END_S = 6000.0, 18000.0
# Postures all over the workspace at which drift is judged.
PLACES = 60
CELL = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1, branches=True, roll_rad=np.pi)


@dataclass(frozen=True, eq=False)
class Warmed:
    """A calibration from the warm-up of an arm."""

    truth: SimulatedCell  # What really was.
    heat: Heat  # What heats the arm.
    warming: Warming  # Its temperatures, all through.
    session: Session  # What was recorded of it.
    calibration: Calibration  # What was made of that.
    whole: Inputs  # What heats the arm, until the end.


def warmed(
    options: CellOptions = CELL, *, temperatures: bool = True, level: str = "thermal", **changes
) -> Warmed:
    """Simulates a warm-up and calibrates with it."""
    how = replace(WarmUpOptions(options, temperatures=temperatures), **changes)
    truth, warming = simulate_warm_up(how), how.warming()
    session = cell_session(truth, "warm-up", seen="poses")
    whole = session.with_streams({"heat": warming.recorded(temperatures=temperatures)})
    inputs = inputs_of(whole, truth.robot.joints.shape[1])
    return Warmed(truth, how.heats, warming, session, calibrate(session, level=level), inputs)


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift since the cold at k places and times, between the training and the fifth hour [m]."""

    true: FloatArray  # (k,) how far the flange really moved.
    left: FloatArray  # (k,) what is left of it when the prediction is taken off.
    sigma: FloatArray  # (k,) how much that is expected to be.

    @property
    def share(self) -> float:
        """What is left, as a share of the drift; of root mean squares."""
        return float(np.sqrt(np.sum(self.left**2) / np.sum(self.true**2)))

    @property
    def error_over_sigma(self) -> float:
        """What is left over what was expected; of root mean squares."""
        return float(np.sqrt(np.mean((self.left / self.sigma) ** 2)))


def drift_of(found: Warmed) -> Drift:
    """Predicts the drift, all over the workspace."""
    truth, model = found.truth, found.calibration.drift
    nominal = load_robot(truth.options.robot)
    q = postures(nominal)[:PLACES]
    at_s = np.linspace(TRAINED_S, END_S, len(q))
    links = model.heating.links_c(found.whole, at_s)
    cold = model.heating.links_c(found.whole, found.whole.stamps_s[:1])[0]
    arm, heat = truth.robot.true_arm, found.heat
    really = found.warming.at(at_s)
    hot, still = (
        heated_poses(arm, heat, q, array)[:, :3, 3]
        for array in (really, np.full_like(really, heat.ambient_c))
    )
    warm, before = (model.base_from_flange(q, array)[:, :3, 3] for array in (links, cold))
    jacobian = model.heating.jacobian(found.whole, at_s)
    return Drift(
        np.linalg.norm(hot - still, axis=1),
        np.linalg.norm(warm - before - (hot - still), axis=1),
        model.sigma_m(q, links, jacobian),
    )
