"""Summaries of results, and their comparison with a simulated truth."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.cli.console import answer, print_table
from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Camera, FloatArray
from visioncal.present.advice import left_out
from visioncal.present.coverage import image_coverage
from visioncal.present.facts import solver_table
from visioncal.results import Calibration, Remedy, Verdict, ViewResult
from visioncal.results.evidence import ViewEvidence

_COLOURS = {"good": "bold green", "check": "bold yellow", "bad": "bold red"}


def print_verdict(verdict: Verdict, name: str) -> None:
    """Prints a verdict with its reasons and next steps."""
    answer(f"  {name}", verdict.status, _COLOURS[verdict.status])
    for line in verdict.top:
        answer(f"  - {line}")
    print_steps(verdict.next_steps)
    if verdict.rest:
        answer("What else was found:")
    for line in verdict.rest:
        answer(f"  - {line}")


def print_steps(steps: Sequence[Remedy]) -> None:
    """Prints the next steps, each command on a line of its own."""
    if steps:
        answer("What to do next:")
    for at, step in enumerate(steps, 1):
        answer(f"  {at}. {step.words}")
        if step.command:
            answer("", f"     {step.command}")


def print_conditions(calibration: Calibration) -> None:
    """Prints what a result is valid for, unless its verdict says so."""
    for words in calibration.unstated_conditions:
        answer(words, "only where: ", "bold yellow")


def print_summary(
    calibration: Calibration, evidence: Sequence[ViewEvidence] = (), *, verbose: bool
) -> None:
    """Prints a result: the verdict first, then the transforms and errors."""
    cell = calibration.cell
    print_verdict(calibration.verdict, calibration.session_name)
    print_conditions(calibration)
    if cell is not None:
        answer(f"the cell's frame is that of {cell.reference}")
    for name, edge in calibration.edges.items():
        sigma = calibration.verdict.accuracy(edge.sigma_words)
        answer(f"{name}: {edge.place_words()}, {sigma}")
        answer(f"  {calibration.rotation_words(name, edge)}")
    if cell is not None:
        for name, levels in cell.noise.items():
            words = [
                f"{figure(value)} {key.rpartition('_')[2]}"
                for key, value in levels.items()
                if key != "level"
            ]
            level = levels.get("level", 1.0)
            if level > 1.2 or not words:
                words.append(f"{figure(level)} times what is said of it")
            answer(f"noise of {name}: {', '.join(words)}")
    else:
        used = sum(view.used for view in calibration.views)
        held = calibration.validation.held_out
        # Larger ones are meaningless.
        answer(
            f"{used} of {len(calibration.views)} views used. "
            f"Checked with views that were not used in the fit: {figure(held.mm)} mm"
            + ("" if held.deg is None else f", {figure(held.deg)} deg")
            + (f", {figure(held.px)} px" if held.px and held.px < 1e4 else "")
        )
        if covered := image_coverage(calibration, evidence):
            answer(f"{covered}.")
    for suspects in left_out(_not_in_verdict(calibration.verdict, calibration.views)):
        answer(f"  {suspects.words}")
    if cell is not None and calibration.verdict.has_accuracy:
        answer(cell.weakest)
    solvers = solver_table(calibration)
    if verbose and solvers is not None:
        print_table(solvers.titles, [row.cells for row in solvers.rows])


def _not_in_verdict(verdict: Verdict, views: Sequence[ViewResult]) -> Iterator[ViewResult]:
    """Views left out, but those of a finding that states the one reason of all its views."""
    findings = [finding for finding in verdict.findings if finding.without_it]
    reasons = {view.view: view.reason for view in views}
    for view in views:
        of_view = [finding for finding in findings if view.view in finding.views]
        if not any(
            finding.kind != "wrong_views"
            or len({reasons[at] for at in finding.views if at in reasons}) < 2
            for finding in of_view
        ):
            yield view


def truth_rows(
    calibration: Calibration, transforms: Mapping[str, FloatArray], camera: Camera
) -> Iterator[tuple[str, str, str, str]]:
    """Errors against the truth in mm, deg and px, their sigmas, and the ratios of both."""
    for name, edge in calibration.edges.items():
        mm, deg = pose_difference(transforms[name], edge.matrix)
        for error, sigma, unit in ((mm, edge.sigma_mm, "mm"), (deg, edge.sigma_deg, "deg")):
            yield name, f"{error:.3f} {unit}", f"{sigma:.3f} {unit}", f"{error / sigma:.2f}"
    if calibration.camera is not None and calibration.camera.covariance is not None:
        sigmas = np.sqrt(np.diag(calibration.camera.covariance))[:4]
        errors = calibration.camera.camera.matrix - camera.matrix
        for name, error, sigma in zip(("fx", "fy", "cx", "cy"), errors, sigmas, strict=True):
            # A fixed parameter has no sigma.
            ratio = f"{abs(error) / sigma:.2f}" if sigma > 0.0 else ""
            yield name, f"{error:+.2f} px", f"{sigma:.2f} px", ratio
