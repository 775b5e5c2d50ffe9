"""Copies: what a session says whose rows are there several times, over what it says once.

Sessions of ten kinds are calibrated once, and with all rows copied: exactly, and with positions
(of poses, of measured poses and of readings) that jitter by 1e-6 to 1e-4 m, behind the session or
row by row.

    PYTHONPATH=tests python tests/benchmarks/copies.py [SESSIONS]
"""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from results import few, first, wished, write_section
from support.fuzz.copied import copied, session_of_kind

from visioncal import calibrate
from visioncal.core.errors import VisioncalError
from visioncal.results import Calibration
from visioncal.session import Session

SESSIONS = 40
# Times that each row is there, jitter [m], and whether a row's copies follow it at once.
COPIES = ((2, 0.0, False), (5, 0.0, True), (2, 1e-6, False), (3, 1e-5, True), (4, 1e-4, False))
STATUSES = ("good", "check", "bad", "refused")
NEED_MM = 0.3
HEAD = """Each session is calibrated once, and with all its rows 2 to 5 times: exactly, and with
positions that jitter by 1e-6 to 1e-4 m. A verdict with copies may be worse than without, as rows
that repeat others are named. Sigmas are those of all transforms, and the smallest ratio of one with
copies to the same without is shown. Time is that with copies over that without, divided by how many
times each row is there.

| session | sessions | copied | better verdict | worse | least sigma ratio | equal | most time |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


@dataclass(frozen=True)
class Said:
    """What a calibration says: its status and sigmas, and the time that it took [s]."""

    status: str
    sigmas: tuple[float, ...]
    seconds: float


def said_of(session: Session) -> Said:
    begun = time.process_time()
    try:
        result: Calibration | None = calibrate(session, need_mm=NEED_MM)
    except VisioncalError:
        result = None
    seconds = time.process_time() - begun
    if result is None:
        return Said("refused", (), seconds)
    sigmas = [value for edge in result.edges.values() for value in (edge.sigma_mm, edge.sigma_deg)]
    return Said(result.verdict.status, tuple(sigmas), seconds)


def main() -> None:
    rows = defaultdict(list)
    for seed in range(wished(SESSIONS, few(SESSIONS, 1))):
        kind, session = session_of_kind(seed)
        once = said_of(session)
        for times, jitter_m, interleaved in first(COPIES):
            more = copied(session, times, jitter_m, seed=seed, interleaved=interleaved)
            said = said_of(more)
            rows[kind].append((seed, times, once, said))
            print(kind, seed, times, jitter_m, once.status, said.status, ratio(once, said),
                  f"{said.seconds / once.seconds:.2f}", flush=True)  # fmt: skip
    write_section("Copies", "PYTHONPATH=tests python tests/benchmarks/copies.py", text(rows))


def ratio(once: Said, said: Said) -> float:
    """The least ratio of a sigma with copies to the same without."""
    pairs = zip(said.sigmas, once.sigmas, strict=False)
    return min((after / before for after, before in pairs if before), default=1.0)


def text(rows: Mapping[str, Sequence[tuple[int, int, Said, Said]]]) -> str:
    """A line for each kind of session."""
    lines = []
    for kind, of in rows.items():
        sessions = len({seed for seed, *_ in of})
        worse = [STATUSES.index(said.status) - STATUSES.index(once.status) for *_, once, said in of]
        lines.append(
            f"| {kind} | {sessions} | {len(of)} | {sum(change < 0 for change in worse)} "
            f"| {sum(change > 0 for change in worse)} "
            f"| {min(ratio(once, said) for *_, once, said in of):.3f} "
            f"| {sum(said.sigmas == once.sigmas for *_, once, said in of)} "
            f"| {max(said.seconds / once.seconds / times for _, times, once, said in of):.2f} |"
        )
    return "\n".join((HEAD, *lines))


if __name__ == "__main__":
    main()
