"""`visioncal diff`."""

from rich.table import Table

from visioncal.cli.console import answers, print_json
from visioncal.cli.result_options import DiffOptions
from visioncal.core.number_format import figure
from visioncal.interchange.result_files import load_result
from visioncal.results.compare import Comparison, LensChange, Significance, compare, to_document

# Below a nanometre and a micro-degree differences are rounding.
_DECIMALS = 6
_LEAST_WIDTH = 110
_WHOLE_PERCENT, _LEAST_PERCENT = 10.0, 0.01


def diff_command(options: DiffOptions) -> None:
    """Runs `visioncal diff`."""
    comparison = compare(
        load_result(options.first),
        load_result(options.second),
        camera=options.part.camera,
        robot=options.part.robot,
        target=options.part.target,
    )
    if options.as_json:
        print_json(to_document(comparison))
        return
    paths = (str(options.first), str(options.second))
    console = answers(markup=False)
    # Names of cells' frames are long, and are not truncated.
    console.width = max(console.width, _LEAST_WIDTH)
    for order, path, mount, verdict in zip(
        ("first", "second"), paths, comparison.mounts, comparison.verdicts, strict=True
    ):
        console.print(f"{order:<7} {path}: {mount}, verdict {verdict}")
    for finding in comparison.findings:
        console.print(f"- {finding}")
    if comparison.edges:
        table = _table("transform", "moved", "sigma", "moved / sigma", "by chance", "")
        for edge in comparison.edges:
            for moved, sigma, unit, test in (
                (edge.moved_mm, edge.sigma_mm, "mm", edge.translation),
                (edge.moved_deg, edge.sigma_deg, "deg", edge.rotation),
            ):
                table.add_row(
                    edge.name,
                    f"{round(moved, _DECIMALS):.3g} {unit}",
                    f"{figure(sigma)} {unit}",
                    f"{moved / sigma:.1f}" if sigma > 0.0 else "",
                    *_outcome(test),
                )
        console.print(table)
    for name, where in (
        *((name, "first") for name in comparison.only_in_a),
        *((name, "second") for name in comparison.only_in_b),
    ):
        console.print(f"{name} is in the {where} only.")
    lens = comparison.lens
    if lens is not None and lens.significance is None and not lens.is_change:
        console.print("The lens was given, and is the same in both.")
    elif lens is not None:
        console.print(_lens_table(lens))
    console.print(_noise_table(comparison))


def _lens_table(lens: LensChange) -> Table:
    table = _table("lens", "first", "second", "difference", "sigma")
    sigmas = [""] * len(lens.names)
    if lens.sigmas is not None:
        sigmas = [figure(sigma) for sigma in lens.sigmas]
    for name, a, b, sigma in zip(lens.names, lens.a, lens.b, sigmas, strict=True):
        table.add_row(name, f"{a:.6g}", f"{b:.6g}", f"{b - a:+.3g}", sigma)
    if lens.significance is not None:
        chance, outcome = _outcome(lens.significance)
        table.caption = f"all together: by chance {chance}, {outcome}"
    return table


def _noise_table(comparison: Comparison) -> Table:
    table = _table("noise, per axis", "first", "second")
    for noise_change in comparison.noise:
        values = (
            "" if value is None else f"{value:.3g}" for value in (noise_change.a, noise_change.b)
        )
        table.add_row(noise_change.name, *values)
    return table


def _outcome(test: Significance) -> tuple[str, str]:
    percent = 100 * test.p_value
    chance = f"{percent:.0f} %" if percent > _WHOLE_PERCENT else f"{figure(percent)} %"
    return (
        "under 0.01 %" if percent < _LEAST_PERCENT else chance,
        "changed" if test.is_change else "noise",
    )


def _table(*columns: str) -> Table:

    table = Table(box=None, pad_edge=False, caption_justify="left")
    for column in columns:
        table.add_column(column, no_wrap=True)
    return table
