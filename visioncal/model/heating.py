"""Heat sources of arms, as sessions record them, and the arms' usual response.

Temperatures or motor currents are read from streams, or else from columns of views. Known
properties of steel, aluminium and of warm-up are priors of what is then estimated.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Robot
from visioncal.robot.thermal import Heating, Inputs, Kind, ThermalModel
from visioncal.session import Session
from visioncal.session.kinds import name_of
from visioncal.session.selecting import streams_of
from visioncal.session.streams import STAMP, Stream

_AMBIENT = "ambient_c"
_FORMS: Mapping[Kind, str] = {"temperatures": "temp{}_c", "currents": "current{}_a"}
# Largest time of views before the first and after the last sample [s].
_BEYOND_S = 300.0
# Fewest samples of a course of temperatures.
FEWEST_SAMPLES = 3
# Prior: relative growth per kelvin (12e-6 of steel, 23e-6 of aluminium); a zero drifts by about a
# hundredth of a millimetre at one metre per kelvin, either way.
_GROWTH_PER_K, _GROWTH_SIGMA_PER_K = 17.5e-6, 5.5e-6
_DRIFT_SIGMA_RAD_PER_K = 1e-5
# Gearboxes warm up in half an hour to an hour and a half; links follow a sensor in minutes.
_TAU_S: Mapping[Kind, float] = {"currents": 2400.0, "temperatures": 120.0}
_TAU_SIGMA: Mapping[Kind, float] = {"currents": 0.6, "temperatures": 1.0}
# Rise of joints at work above the air, within a factor [K].
_RISE_K, _GAIN_SIGMA = 20.0, 0.8
# Smaller rises of all joints determine nothing [K].
LEAST_RISE_K = 3.0


def recorded_inputs(session: Session, joints: int, robot: str = "") -> Inputs | None:
    """Reads what heats an arm with some joints; temperatures come before currents.

    None where neither is known of all joints together.
    """
    numbers = {
        view.stamp_s: view.numbers
        for view in session.views
        if view.stamp_s is not None and name_of(session.declaration, "robot", view) == robot
    }
    names = sorted({name for row in numbers.values() for name in row} - {STAMP})
    rows = [
        [stamp_s, *(row.get(name, np.nan) for name in names)]
        for stamp_s, row in sorted(numbers.items())
    ]
    of_views = Stream((STAMP, *names), np.array(rows).reshape(len(rows), len(names) + 1))
    tables = [*streams_of(session, robot).values(), of_views]
    for kind, form in _FORMS.items():
        for table in tables:
            stamps_s, heat = table.group([form.format(at + 1) for at in range(joints)])
            if len(stamps_s) >= FEWEST_SAMPLES:
                return _averaged(kind, stamps_s, heat, tables)
    return None


def _averaged(
    kind: Kind, stamps_s: FloatArray, heat: FloatArray, tables: Sequence[Stream]
) -> Inputs:
    """The inputs with the first recorded air temperature, averaged in groups of samples."""
    of_air = (table.group((_AMBIENT,)) for table in tables)
    at_s, air = next((group for group in of_air if len(group[0])), (stamps_s, np.zeros((1, 1))))
    ambient = np.interp(stamps_s, at_s, np.broadcast_to(air[:, 0], len(at_s)))
    columns = np.column_stack([stamps_s, ambient, heat if kind == "temperatures" else heat**2])
    # More samples determine warm-up no better: they are averaged in groups.
    starts = np.arange(0, len(columns), -(-len(columns) // 8192))
    lengths = np.diff(np.append(starts, len(columns)))
    means = np.add.reduceat(columns, starts) / lengths[:, None]
    return Inputs(kind, means[:, 0], means[:, 2:], means[:, 1])


def is_recorded(inputs: Inputs, stamps_s: FloatArray) -> bool:
    """Whether the inputs cover some times [s]."""
    first_s, last_s = inputs.stamps_s[[0, -1]] + (-_BEYOND_S, _BEYOND_S)
    return bool(((stamps_s >= first_s) & (stamps_s <= last_s)).all())


def usual_heating(inputs: Inputs) -> Heating:
    """How the links of most arms follow what heats them."""
    count = inputs.signal.shape[1]
    gain = np.ones(count)
    if inputs.kind == "currents":
        gain = _RISE_K / np.maximum(inputs.signal.mean(axis=0), 1e-9)
    return Heating(inputs.kind, np.full(count, _TAU_S[inputs.kind]), gain)


def usual_arm(robot: Robot, nominal: Robot, inputs: Inputs) -> ThermalModel:
    """An arm that follows what heats it as most do, and is as stated at the first sample.

    `robot` is up to the frame of its poses; the lengths of `nominal` grow.
    """
    count, heating = robot.joint_count, usual_heating(inputs)
    return ThermalModel(
        robot,
        heating,
        heating.links_c(inputs, inputs.stamps_s[:1])[0],
        np.full(count, _GROWTH_PER_K),
        np.zeros(count),
        np.zeros((0, 0)),
        nominal.chain.placements[:, :3, 3],
    )


def sigmas_of(inputs: Inputs) -> FloatArray:
    """(p,) by how much arms differ from the usual one; see `ThermalModel.covariance`."""
    sizes = [_GROWTH_SIGMA_PER_K, _DRIFT_SIGMA_RAD_PER_K, _TAU_SIGMA[inputs.kind]]
    sizes += [_GAIN_SIGMA] * (inputs.kind == "currents")
    return np.repeat(sizes, inputs.signal.shape[1])
