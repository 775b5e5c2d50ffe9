"""`visioncal diff`."""

from visioncal.cli.console import answer, print_json, print_table
from visioncal.cli.result_options import DiffOptions
from visioncal.core.number_format import figure
from visioncal.interchange.result_files import load_result
from visioncal.results.compare import LensChange, Significance, compare, to_document


def diff_command(options: DiffOptions) -> None:
    """Runs `visioncal diff`."""
    comparison = compare(
        load_result(options.first),
        load_result(options.second),
        camera=options.camera,
        robot=options.robot,
        target=options.target,
    )
    if options.as_json:
        print_json(to_document(comparison))
        return
    if comparison.is_equal:
        answer("Both hold the same result.")
        return
    paths = (str(options.first), str(options.second))
    for order, path, mount, verdict in zip(
        ("first", "second"), paths, comparison.mounts, comparison.verdicts, strict=True
    ):
        answer(f"{order:<7} {path}: {mount}, verdict {verdict}")
    for finding in comparison.findings:
        answer(f"- {finding}")
    if comparison.edges:
        # Below a nanometre and a micro-degree differences are rounding.
        rows = [
            (
                edge.name,
                f"{round(moved, 6):.3g} {unit}",
                f"{figure(sigma)} {unit}",
                f"{moved / sigma:.1f}" if sigma > 0.0 else "",
                *_outcome(test),
            )
            for edge in comparison.edges
            for moved, sigma, unit, test in (
                (edge.moved_mm, edge.sigma_mm, "mm", edge.translation),
                (edge.moved_deg, edge.sigma_deg, "deg", edge.rotation),
            )
        ]
        print_table(("transform", "moved", "sigma", "moved / sigma", "by chance", ""), rows)
    for name, where in (
        *((name, "first") for name in comparison.only_in_a),
        *((name, "second") for name in comparison.only_in_b),
    ):
        answer(f"{name} is in the {where} only.")
    if comparison.lens is not None:
        _print_lens(comparison.lens)
    noise = [
        (name, *("" if level is None else f"{level:.3g}" for level in levels))
        for name, levels in comparison.noise.items()
    ]
    print_table(("noise, per axis", "first", "second"), noise)


def _print_lens(lens: LensChange) -> None:
    if lens.significance is None and not lens.is_change:
        answer("The lens was given, and is the same in both.")
    else:
        sigmas = [""] * len(lens.names)
        if lens.sigmas is not None:
            sigmas = [figure(sigma) for sigma in lens.sigmas]
        caption = ""
        if lens.significance is not None:
            caption = "all together: by chance {}, {}".format(*_outcome(lens.significance))
        changes = [
            (name, f"{a:.6g}", f"{b:.6g}", f"{b - a:+.3g}", sigma)
            for name, a, b, sigma in zip(lens.names, lens.a, lens.b, sigmas, strict=True)
        ]
        print_table(("lens", "first", "second", "difference", "sigma"), changes, caption=caption)


def _outcome(test: Significance) -> tuple[str, str]:
    percent = 100 * test.p_value
    chance = f"{percent:.0f} %" if percent > 10.0 else f"{figure(percent)} %"
    return ("under 0.01 %" if percent < 0.01 else chance, "changed" if test.is_change else "noise")
