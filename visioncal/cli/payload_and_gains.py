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
from visioncal.dynamics.run import conditioned_streams, current_streams, robot_of, select_arm
from visioncal.robot import Inertias, symmetric_matrices
from visioncal.session import Session


def print_payload(options: PayloadOptions) -> None:
    """Estimates the payload, and prints it.

    Raises:
        DataError: There are no identified dynamics, or the streams do not determine the payload.
    """
    identified = identified_of(options.against, "payload")
    loaded = conditioned_streams(
        Session.load(options.session), identified, options.streams.request()
    )
    payload = estimate_payload(
        identified,
        loaded,
        friction_changes=not options.same_friction,
        gain_sigma=0.01 * options.gains_sigma,
    )
    if options.as_json:
        print_json(payload.document())
        return
    for note in (note for conditioned in loaded for note in conditioned.notes):
        say(note)
    typer.echo("\n".join(_lines(payload)))


def print_gains(options: GainsOptions) -> None:
    """Estimates the torque constants of an arm's drives from a known body on its flange.

    Raises:
        DataError: The body is invalid, or the sessions cannot be read or have no currents.
    """
    body = _body(options)
    without = select_arm(Session.load(options.session), options.named)
    robot = robot_of(without)
    empty = current_streams(without, robot, options.cutoff_hz)
    full = current_streams(
        select_arm(Session.load(options.loaded), options.named),
        robot,
        options.cutoff_hz or empty[0].cutoff_hz,
    )
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms(motor_inertia=True)))
    gains = drive_gains(base, empty, full, body)
    if options.as_json:
        print_json([_row(name, gains, at) for at, name in enumerate(robot.joint_names)])
        return
    _report_gains(robot.joint_names, gains)


def _lines(payload: Payload) -> list[str]:
    mass = f"{matched(payload.mass_kg, payload.mass_sigma_kg)} kg"
    centre = _with_sigmas(1e3 * payload.centre_m, 1e3 * payload.centre_sigma_m)
    lines = [
        f"mass {mass} (sigma {significant(payload.mass_sigma_kg)}{_gains_part(payload)})",
        f"centre {centre} mm in the flange's frame",
    ]
    if payload.consistent:
        inertia = ", ".join(f"{value:.4g}" for value in payload.inertia_kg_m2)
        lines.append(f"inertia about it (xx, xy, yy, xz, yz, zz) {inertia} kg m^2")
    else:
        lines.append("its inertia is lost in the noise")
    left = ", ".join(significant(rm) for rm in payload.rms_nm.tolist())
    lines.append(f"unexplained {left} N m, joint by joint")
    return [*lines, f"on a UR: {_ur_words(payload)}"]


def _gains_part(payload: Payload) -> str:
    """The part of the mass's sigma that is due to the drives' gains; empty for none."""
    if not payload.gains_sigma_kg:
        return ""
    return f", {significant(payload.gains_sigma_kg)} of it from the drives' gains"


def _with_sigmas(values: FloatArray, sigmas: FloatArray) -> str:
    pairs = zip(values.tolist(), sigmas.tolist(), strict=True)
    return ", ".join(
        f"{matched(value, sigma)} (sigma {significant(sigma)})" for value, sigma in pairs
    )


def _ur_words(payload: Payload) -> str:
    """The payload as a UR's program sets it, in kg, m and kg m^2."""
    centre = ", ".join(f"{value:.5f}" for value in payload.centre_m)
    if not payload.consistent:
        return f"set_target_payload({payload.mass_kg:.4f}, [{centre}])"
    xx, xy, yy, xz, yz, zz = payload.inertia_kg_m2.tolist()
    inertia = ", ".join(f"{value:.6f}" for value in (xx, yy, zz, xy, xz, yz))
    return f"set_target_payload({payload.mass_kg:.4f}, [{centre}], [{inertia}])"


def _body(options: GainsOptions) -> FloatArray:
    """(10,) the body's inertial parameters in the flange's frame."""
    centre = 1e-3 * np.array(numbers_in(options.com_mm, "--com-mm", "x,y,z"))
    about = symmetric_matrices(
        np.array(numbers_in(options.inertia, "--inertia", "xx,xy,yy,xz,yz,zz"))
    )
    body = Inertias.of_bodies(np.array([options.mass_kg]), centre[None], about[None])
    if not (options.mass_kg > 0.0 and body.consistent):
        raise DataError(
            f"--mass-kg {options.mass_kg:g} and --inertia {options.inertia} are those of no body.",
            culprits=["--mass-kg", "--inertia"],
            next_step="A mass above 0 kg is needed, and an inertia about its centre; none stands "
            "for a body as small as a point.",
        )
    return np.asarray(body.values[0])


def _row(name: str, gains: Gains, joint: int) -> dict[str, str | float]:
    """The gain of a drive; only the joint where it is not determined."""
    if not gains.determined[joint]:
        return {"joint": name}
    gain, sigma = float(gains.nm_per_a[joint]), float(gains.sigma[joint])
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
        typer.echo(f"--gains {','.join(f'{value:.5g}' for value in found.nm_per_a)}")
    else:
        say(
            "--gains needs all joints: move those that are not determined more, or take a body "
            "that is heavier or whose centre is farther from their axes."
        )
