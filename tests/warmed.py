"""Arms that warm up, fitted as the stages do, and what is left of their drift hours later."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimator.closure import Closure, Edges
from visioncal.estimator.workspace import postures
from visioncal.robot import Robot, load_robot
from visioncal.simulation import CellOptions, Heat, WarmUp, WarmUpOptions, simulate_warm_up
from visioncal.simulation.optics import fine_camera
from visioncal.simulation.warmup import heated_poses
from visioncal.thermal import Inputs, ThermalFit, ThermalModel, fit_thermal, inputs_of
from visioncal.thermal.fit import Stops
from visioncal.types import FloatArray

# What 100 minutes are to predict: the rest of five hours [s].
TRAINED_S, END_S = 6000.0, 18000.0
CELL = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)


@dataclass(frozen=True, eq=False)
class Warmed:
    """A fit of a session's views."""

    truth: WarmUp
    inputs: Inputs
    robot: Robot
    fit: ThermalFit


def warmed(options: CellOptions = CELL, *, temperatures: bool = True, **changes) -> Warmed:
    """Simulates a warm-up and fits it, with the arm as stated."""
    truth = simulate_warm_up(replace(WarmUpOptions(options), **changes))
    session, robot = truth.session("warm", temperatures=temperatures), load_robot(options.robot)
    inputs, missing = inputs_of(session, robot.joint_count)
    assert inputs is not None, missing
    return Warmed(truth, inputs, robot, fitted(truth, session, robot, inputs))


def fitted(truth: WarmUp, session, robot: Robot, inputs: Inputs) -> ThermalFit:
    q = np.array([it.joints_rad for it in session.views])
    camera = np.array([it.cam_from_target().as_matrix() for it in session.views])
    flange = robot.base_from_flange(q)
    x, z = truth.cell.transforms.values()
    data = Closure("eye-in-hand", flange, camera)
    return fit_thermal(
        data, Edges(x, z, np.zeros(0)), robot, Stops(q, truth.stamps_s), inputs, robot
    )


def left_over(found: Warmed, *, temperatures: bool) -> tuple[FloatArray, FloatArray]:
    """What is left of the drift since the cold, and the drift, all over the workspace [m].

    Between the end of the training and the fifth hour: (k,) distances each.
    """
    q = postures(found.robot)[:40]
    at_s = np.linspace(TRAINED_S, END_S, len(q))
    whole = found.truth.warming.recorded(temperatures=temperatures)
    session = found.truth.session("whole", temperatures=temperatures)
    inputs, _ = inputs_of(session.with_streams({"heat": whole}), found.robot.joint_count)
    predicted = _moved(found.fit.model, inputs, q, at_s)
    true = _truly_moved(found.truth, found.truth.heat, q, at_s)
    return np.linalg.norm(predicted - true, axis=1), np.linalg.norm(true, axis=1)


def _moved(model: ThermalModel, inputs: Inputs, q: FloatArray, at_s: FloatArray) -> FloatArray:
    links = model.heating.links_c(inputs, np.append(at_s, inputs.stamps_s[0]))
    warm, cold = (model.base_from_flange(q, it) for it in (links[:-1], links[-1]))
    return (warm - cold)[:, :3, 3]


def _truly_moved(truth: WarmUp, heat: Heat, q: FloatArray, at_s: FloatArray) -> FloatArray:
    links, arm = truth.warming.at(at_s), truth.cell.true_arm
    cold = np.full_like(links, heat.ambient_c)
    return (heated_poses(arm, heat, q, links) - heated_poses(arm, heat, q, cold))[:, :3, 3]
