"""A site of simulated years: the entries of twelve cells, five of which have something to say."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray, Need
from visioncal.results.edge import Edge
from visioncal.results.history import Entry

NOW = datetime(2026, 11, 26, 12, tzinfo=UTC)
STORIES = ("knocked", "creeping jig", "not verified", "new print", "turned bad")
# Sigma of a transform per axis [m], and the jig's creep in a year [m].
SIGMA_M, CREEP_M = 0.05e-3, 0.8e-3


def acts(cell: str, seed: int) -> Iterator[Entry]:
    """Two years of a cell, which is calibrated and verified in turn, month by month.

    The camera of `knocked` steps by 0.7 mm and 1 mrad at day 450, the jig of `creeping jig` creeps
    along its x; nobody comes to `not verified` after day 500, the sigma of `new print` is twice as
    large from then on, and `turned bad` is bad from day 660 on.
    """
    rng = np.random.default_rng(seed)
    camera, jig, tool = exp(0.3 * rng.normal(size=(3, 6)))

    def act(day: float, kind: str, edges: dict[str, Edge], **more: object) -> Entry:
        at = (NOW - timedelta(days=735 - day)).isoformat()
        facts = {"status": "good", "reason": f"All agree in {kind}.", "robot": "ur10e"}
        return Entry(
            **facts
            | {"cell": cell, "at": at, "kind": kind, "edges": edges, "sha256": f"{cell} {seed}"}
            | more
        )

    def placed(pose: FloatArray, sigma_m: float = SIGMA_M) -> Edge:
        covariance = np.diag([2.0 * sigma_m] * 3 + [sigma_m] * 3) ** 2
        return Edge(pose @ exp(rng.multivariate_normal(np.zeros(6), covariance)), covariance)

    for day in range(0, 730, 30):
        if cell == "not verified" and day > 500:
            return
        is_bad = cell == "turned bad" and day >= 660
        is_knocked, is_print = (cell, day >= 450) == ("knocked", True), cell == "new print"
        stands = camera @ exp(is_knocked * np.array([1e-3, 0, 0, 0.5e-3, 0.4e-3, -0.3e-3]))
        if day % 60:
            yield act(day, "verified", {})
        else:
            edges = {
                "flange_from_cam": placed(stands, SIGMA_M * (2 if is_print and day > 500 else 1)),
                "base_from_target": placed(exp(rng.normal(size=6))),
            }
            yield act(
                day,
                "calibrated",
                edges,
                boards=("base_from_target",),
                need=Need(mm=0.5),
                good_for_mm=0.25,
                figures={"views": 20.0, "used": 19.0, "sigma_mm": 0.09, "radius95_mm": 0.2},
                **{"status": "bad", "reason": "The board is bent by 1.2 mm."} if is_bad else {},
            )
        if day % 90 == 0:
            crept = np.array([0, 0, 0, CREEP_M * day / 365.25, 0, 0])
            yield act(
                day + 0.1,
                "fixture",
                {"base_from_jig": placed(jig @ exp((cell == "creeping jig") * crept))},
            )
        if day % 180 == 0:
            yield act(day + 0.2, "tool", {"flange_from_gripper": placed(tool)})


def entries(seed: int = 0) -> list[Entry]:
    """The entries of twelve cells in the order of time."""
    cells = [*STORIES, *(f"line {at}" for at in range(7))]
    found = [one for at, cell in enumerate(cells) for one in acts(cell, 100 * seed + at)]
    return sorted(found, key=lambda one: one.at)
