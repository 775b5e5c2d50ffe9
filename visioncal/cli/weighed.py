"""Payload and drive gains from a body on the flange, for `visioncal dynamics`."""

import numpy as np
import typer

from visioncal.cli.console import print_json, say
from visioncal.cli.dynamics import identified_of
from visioncal.cli.dynamics_gains import GainsOptions
from visioncal.cli.dynamics_payload import PayloadOptions
from visioncal.cli.parsing import numbers_in
from visioncal.core.errors import DataError
from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.dynamics import (
    BaseModel,
    DynamicModel,
    FrictionTerms,
    Gains,
    Payload,
    drive_gains,
    estimate_payload,
)
from visioncal.dynamics.run import conditioned_streams, current_streams, of_one_arm, robot_of
from visioncal.robot import Inertias, matrices
from visioncal.session import Session


def print_payload(asked: PayloadOptions) -> None:
    """Estimates the payload, and prints it.

    Raises:
        DataError: There are no identified dynamics, or the streams do not determine the payload.
    """
    identified = identified_of(asked.against, "payload")
    loaded = conditioned_streams(Session.load(asked.session), identified, asked.streams.request())
    found = estimate_payload(
        identified,
        loaded,
        friction_changes=not asked.same_friction,
        gain_sigma=0.01 * asked.gains_sigma,
    )
    if asked.as_json:
        print_json(found.document())
        return
    for note in (note for conditioned in loaded for note in conditioned.notes):
        say(note)
    typer.echo("\n".join(_lines(found)))


def print_gains(asked: GainsOptions) -> None:
    """Estimates the torque constants of an arm's drives from a known body on its flange.

    Raises:
        DataError: The body is invalid, or the sessions cannot be read or have no currents.
    """
    body = _body(asked)
    without = of_one_arm(Session.load(asked.session), asked.named)
    robot = robot_of(without)
    empty = current_streams(without, robot, asked.cutoff_hz)
    full = current_streams(
        of_one_arm(Session.load(asked.loaded), asked.named),
        robot,
        asked.cutoff_hz or empty[0].cutoff_hz,
    )
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms(motor_inertia=True)))
    found = drive_gains(base, empty, full, body)
    if asked.as_json:
        print_json([_row(name, found, at) for at, name in enumerate(robot.joint_names)])
        return
    _report_gains(robot.joint_names, found)


def _lines(found: Payload) -> list[str]:
    mass = f"{matched(found.mass_kg, found.mass_sigma_kg)} kg"
    centre = _listed(1e3 * found.centre_m, 1e3 * found.centre_sigma_m)
    lines = [
        f"mass {mass} (sigma {significant(found.mass_sigma_kg)}{_of_gains(found)})",
        f"centre {centre} mm in the flange's frame",
    ]
    if found.consistent:
        inertia = ", ".join(f"{value:.4g}" for value in found.inertia_kg_m2)
        lines.append(f"inertia about it (xx, xy, yy, xz, yz, zz) {inertia} kg m^2")
    else:
        lines.append("its inertia is lost in the noise")
    left = ", ".join(significant(rm) for rm in found.rms_nm.tolist())
    lines.append(f"unexplained {left} N m, joint by joint")
    return [*lines, f"on a UR: {_ur_words(found)}"]


def _of_gains(found: Payload) -> str:
    """The part of the mass's sigma that is due to the drives' gains; empty for none."""
    if not found.gains_sigma_kg:
        return ""
    return f", {significant(found.gains_sigma_kg)} of it from the drives' gains"


def _listed(values: FloatArray, sigmas: FloatArray) -> str:
    pairs = zip(values.tolist(), sigmas.tolist(), strict=True)
    return ", ".join(
        f"{matched(value, sigma)} (sigma {significant(sigma)})" for value, sigma in pairs
    )


def _ur_words(found: Payload) -> str:
    """The payload as a UR's program sets it, in kg, m and kg m^2."""
    centre = ", ".join(f"{value:.5f}" for value in found.centre_m)
    if not found.consistent:
        return f"set_target_payload({found.mass_kg:.4f}, [{centre}])"
    xx, xy, yy, xz, yz, zz = found.inertia_kg_m2.tolist()
    inertia = ", ".join(f"{value:.6f}" for value in (xx, yy, zz, xy, xz, yz))
    return f"set_target_payload({found.mass_kg:.4f}, [{centre}], [{inertia}])"


def _body(asked: GainsOptions) -> FloatArray:
    """(10,) the body's inertial parameters in the flange's frame."""
    centre = 1e-3 * np.array(numbers_in(asked.com_mm, "--com-mm", "x,y,z"))
    about = matrices(np.array(numbers_in(asked.inertia, "--inertia", "xx,xy,yy,xz,yz,zz")))
    body = Inertias.of_bodies(np.array([asked.mass_kg]), centre[None], about[None])
    if not (asked.mass_kg > 0.0 and body.consistent):
        raise DataError(
            f"--mass-kg {asked.mass_kg:g} and --inertia {asked.inertia} are those of no body.",
            culprits=["--mass-kg", "--inertia"],
            next_step="A mass above 0 kg is needed, and an inertia about its centre; none stands "
            "for a body as small as a point.",
        )
    return np.asarray(body.values[0])


def _row(name: str, found: Gains, at: int) -> dict[str, str | float]:
    """The gain of a drive; only the joint where it is not determined."""
    if not found.determined[at]:
        return {"joint": name}
    gain, sigma = float(found.nm_per_a[at]), float(found.sigma[at])
    return {"joint": name, "nm_per_a": gain, "sigma_nm_per_a": sigma}


def _report_gains(names: tuple[str, ...], found: Gains) -> None:
    for name, gain, sigma, determined in zip(
        names, found.nm_per_a.tolist(), found.sigma.tolist(), found.determined, strict=True
    ):
        words = "not determined: the body hardly moves it"
        if determined:
            words = f"{matched(gain, sigma)} N m/A (sigma {significant(sigma)})"
        say(f"{name}: {words}")
    if found.determined.all():
        gains = ",".join(f"{value:.5g}" for value in found.nm_per_a)
        typer.echo(f"--gains {gains}")
    else:
        say(
            "--gains needs all joints: move those that are not determined more, or take a body "
            "that is heavier or whose centre is farther from their axes."
        )
