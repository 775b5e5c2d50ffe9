"""`visioncal dynamics payload`."""

import json
from typing import Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages
from visioncal.cli.dynamics_options import (
    AgainstOption,
    MotionsArgument,
    StreamOptions,
    identified_of,
)
from visioncal.cli.options import AsJson
from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.dynamics import Payload, estimate_payload
from visioncal.dynamics.payload import GAIN_SIGMA
from visioncal.dynamics.run import conditioned_streams
from visioncal.session import Session


def dynamics_payload_command(
    session: MotionsArgument,
    streams: StreamOptions,
    against: AgainstOption = None,
    same_friction: Annotated[
        bool,
        typer.Option(
            "--same-friction", help="Friction is as it was without the payload, however it presses."
        ),
    ] = False,
    gains_sigma: Annotated[
        float,
        typer.Option(
            "--gains-sigma",
            min=0.0,
            help="What each of the --gains is known to, in percent.",
        ),
    ] = 100.0 * GAIN_SIGMA,
    as_json: AsJson = False,
) -> None:
    """Weigh what the arm carries, by how much more its drives gave than without it.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    identified = identified_of(against, "payload")
    loaded = conditioned_streams(Session.load(session), identified, streams.request())
    found = estimate_payload(
        identified, loaded, friction_changes=not same_friction, gain_sigma=0.01 * gains_sigma
    )
    if as_json:
        typer.echo(json.dumps(found.document(), indent=2))
        return
    for note in (note for it in loaded for note in it.notes):
        messages().print(escape(note))
    typer.echo("\n".join(_lines(found)))


def _lines(found: Payload) -> list[str]:
    mass = f"{matched(found.mass_kg, found.mass_sigma_kg)} kg"
    centre = _listed(1e3 * found.centre_m, 1e3 * found.centre_sigma_m)
    lines = [
        f"mass {mass} (sigma {significant(found.mass_sigma_kg)}{_of_gains(found)})",
        f"centre {centre} mm in the flange's frame",
    ]
    if found.consistent:
        inertia = ", ".join(f"{it:.4g}" for it in found.inertia_kg_m2)
        lines.append(f"inertia about it (xx, xy, yy, xz, yz, zz) {inertia} kg m^2")
    else:
        lines.append("its inertia is lost in the noise")
    left = ", ".join(significant(it) for it in found.rms_nm.tolist())
    lines.append(f"unexplained {left} N m, joint by joint")
    return [*lines, f"on a UR: {_ur_words(found)}"]


def _of_gains(found: Payload) -> str:
    """What of the mass's sigma the drives' gains make up, where they do."""
    if not found.gains_sigma_kg:
        return ""
    return f", {significant(found.gains_sigma_kg)} of it from the drives' gains"


def _listed(values: FloatArray, sigmas: FloatArray) -> str:
    pairs = zip(values.tolist(), sigmas.tolist(), strict=True)
    return ", ".join(f"{matched(it, sigma)} (sigma {significant(sigma)})" for it, sigma in pairs)


def _ur_words(found: Payload) -> str:
    """The payload as a UR's program sets it, in kg, m and kg m^2."""
    centre = ", ".join(f"{it:.5f}" for it in found.centre_m)
    if not found.consistent:
        return f"set_target_payload({found.mass_kg:.4f}, [{centre}])"
    xx, xy, yy, xz, yz, zz = found.inertia_kg_m2.tolist()
    inertia = ", ".join(f"{it:.6f}" for it in (xx, yy, zz, xy, xz, yz))
    return f"set_target_payload({found.mass_kg:.4f}, [{centre}], [{inertia}])"
