"""The table and the page of an arm's performance by ISO 9283."""

from collections.abc import Mapping, Sequence
from typing import Any

from visioncal.core.number_format import figure
from visioncal.core.verdict import Verdict
from visioncal.present.report.templates import template
from visioncal.present.tables import Table


def performance_table(document: Mapping[str, Any]) -> Table:
    """AP and RP of each pose with their intervals; see `iso9283.Performance.document`."""
    rows = []
    for pose in document["poses"]:
        value, low, high = map(figure, pose["accuracy_mm"])
        rp, least, most = pose["repeatability_mm"]
        spread = f"{figure(rp)} ({figure(least)} to {figure(most)})"
        turns = pose.get("repeatability_deg", ())
        rows.append(
            (
                pose["pose"],
                str(pose["cycles"]),
                f"{value} ({low} to {high})",
                f"at most {figure(most)}" if least == 0.0 else spread,
                figure(pose["device_mm"]),
                ", ".join(figure(turn[2] if turn[1] == 0.0 else turn[0]) for turn in turns),
            )
        )
    titles = ("pose", "cycles", "AP [mm]", "RP [mm]", "device alone [mm]", "RP a, b, c [deg]")
    return Table.of(titles, rows, (0, 2, 3, 5))


def render_performance(
    name: str, against: str, document: Mapping[str, Any], sentences: Sequence[str]
) -> str:
    """Renders the page of a test as HTML text."""
    return template("performance.html.j2").render(
        kind="Pose performance, ISO 9283",
        name=name,
        subtitle=f"measured by the calibration {against}",
        notes=sentences,
        judged=Verdict.of("good"),
        provenance={"session": name, "calibration": against},
        performance=performance_table(document),
        stated=document["stated"],
    )
