"""`visioncal demo`."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from visioncal.calibration import Calibration
from visioncal.cli.console import messages, print_summary, shown_progress
from visioncal.outputs import write_outputs
from visioncal.pipeline import run
from visioncal.session import Session
from visioncal.simulation import CellOptions, Truth, read_truth, simulate, truth_path, write_session
from visioncal.transforms import invert, rotation_angle


def demo_command(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the session and its result.")
    ] = Path("demo"),
    views: Annotated[int, typer.Option(min=3, help="Number of views.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Another cell for every number.")] = 0,
) -> None:
    """Simulate a UR cell, calibrate it from its images, and compare with the truth.

    The camera's intrinsics are not given: they too are estimated from the images.
    """
    session, result = out / "session", out / "result"
    options = CellOptions(views=views, seed=seed, state_intrinsics=False)
    with shown_progress(quiet=False) as told:
        _replace_session(
            options, session, lambda share: told("render", round(share * views), views)
        )
        loaded = Session.load(session)
        done = run(loaded, progress=told)
        told("write", 0, 1)
        files = write_outputs(result, loaded, done)
    print_summary(done.calibration, verbose=True)
    messages().print(_comparison(done.calibration, read_truth(session)))
    for file in (session, truth_path(session), *files):
        messages().print(f"wrote {file}")
    messages().print(f"Open {result / 'report.html'} in a browser to see it all.")


def _replace_session(options: CellOptions, folder: Path, progress: Callable[[float], None]) -> None:
    """Simulates a session in the place of an earlier demo's; nothing else is ever removed."""
    if folder.exists() and truth_path(folder).exists():
        shutil.rmtree(folder)
    write_session(simulate(options), folder, progress)


def _comparison(calibration: Calibration, truth: Truth) -> Table:
    """Errors against the truth, in millimetres and degrees and in units of the sigma."""
    table = Table("against the truth", "error", "sigma", "error / sigma", box=None)
    for name, edge in calibration.edges.items():
        away = invert(truth.transforms[name]) @ edge.transform.as_matrix()
        for figure, sigma, unit in (
            (1e3 * float(np.linalg.norm(away[:3, 3])), edge.sigma_mm, "mm"),
            (float(np.rad2deg(rotation_angle(away))), edge.sigma_deg, "deg"),
        ):
            table.add_row(
                name, f"{figure:.3f} {unit}", f"{sigma:.3f} {unit}", f"{figure / sigma:.2f}"
            )
    if calibration.camera is not None and calibration.camera.covariance is not None:
        sigmas = np.sqrt(np.diag(calibration.camera.covariance))[:4]
        errors = calibration.camera.camera.matrix - truth.camera.matrix
        for name, error, sigma in zip(("fx", "fy", "cx", "cy"), errors, sigmas, strict=True):
            table.add_row(name, f"{error:+.2f} px", f"{sigma:.2f} px", f"{abs(error) / sigma:.2f}")
    return table
