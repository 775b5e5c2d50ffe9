"""`visioncal dynamics gains`."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli.console import messages
from visioncal.cli.dynamics_options import CutoffOption, MotionsArgument
from visioncal.cli.numbers import numbers_in
from visioncal.cli.options import AsJson, RobotName
from visioncal.core.errors import DataError
from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.dynamics import BaseModel, DynamicModel, FrictionTerms, Gains, drive_gains
from visioncal.dynamics.run import current_streams, of_one_arm, robot_of
from visioncal.robot import Inertias, matrices
from visioncal.session import Session


def dynamics_gains_command(
    session: MotionsArgument,
    loaded: Annotated[
        Path, typer.Option("--loaded", help="A session of the same arm with the body on it.")
    ],
    mass_kg: Annotated[float, typer.Option("--mass-kg", help="Of the body (kg).")],
    com_mm: Annotated[
        str,
        typer.Option(
            "--com-mm", metavar="X,Y,Z", help="Its centre of mass in the flange's frame (mm)."
        ),
    ],
    inertia: Annotated[
        str,
        typer.Option(
            "--inertia",
            metavar="XX,XY,YY,XZ,YZ,ZZ",
            help="Its inertia about that centre (kg m^2).",
        ),
    ] = "0,0,0,0,0,0",
    cutoff_hz: CutoffOption = None,
    named: RobotName = None,
    as_json: AsJson = False,
) -> None:
    """Find how much torque a drive's current makes, by a body that is known.

    Exit status 0: there are gains; 2: there are none, for the reason given.
    """
    body = _body(mass_kg, com_mm, inertia)
    without = of_one_arm(Session.load(session), named)
    robot = robot_of(without)
    empty = current_streams(without, robot, cutoff_hz)
    full = current_streams(
        of_one_arm(Session.load(loaded), named), robot, cutoff_hz or empty[0].cutoff_hz
    )
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms(motor_inertia=True)))
    found = drive_gains(base, empty, full, body)
    if as_json:
        document = [_row(name, found, at) for at, name in enumerate(robot.joint_names)]
        typer.echo(json.dumps(document, indent=2))
        return
    _report(robot.joint_names, found)


def _body(mass_kg: float, com_mm: str, inertia: str) -> FloatArray:
    """(10,) the body's inertial parameters in the flange's frame.

    Raises:
        DataError: There is no such body.
    """
    centre = 1e-3 * np.array(numbers_in(com_mm, "--com-mm", "x,y,z"))
    about = matrices(np.array(numbers_in(inertia, "--inertia", "xx,xy,yy,xz,yz,zz")))
    body = Inertias.of_bodies(np.array([mass_kg]), centre[None], about[None])
    if not (mass_kg > 0.0 and body.consistent):
        raise DataError(
            f"--mass-kg {mass_kg:g} and --inertia {inertia} are those of no body.",
            culprits=["--mass-kg", "--inertia"],
            next_step="A mass above 0 kg is needed, and an inertia about its centre; none stands "
            "for a body as small as a point.",
        )
    return np.asarray(body.values[0])


def _row(name: str, found: Gains, at: int) -> dict[str, str | float]:
    """The gain of a drive; the joint alone where it is not determined."""
    if not found.determined[at]:
        return {"joint": name}
    gain, sigma = float(found.nm_per_a[at]), float(found.sigma[at])
    return {"joint": name, "nm_per_a": gain, "sigma_nm_per_a": sigma}


def _report(names: tuple[str, ...], found: Gains) -> None:
    for name, gain, sigma, determined in zip(
        names, found.nm_per_a.tolist(), found.sigma.tolist(), found.determined, strict=True
    ):
        words = "not determined: the body hardly moves it"
        if determined:
            words = f"{matched(gain, sigma)} N m/A (sigma {significant(sigma)})"
        messages().print(escape(f"{name}: {words}"))
    if found.determined.all():
        gains = ",".join(f"{it:.5g}" for it in found.nm_per_a)
        typer.echo(f"--gains {gains}")
    else:
        messages().print(
            "--gains needs all joints: move those that are not determined more, or take a body "
            "that is heavier or whose centre is farther from their axes."
        )
