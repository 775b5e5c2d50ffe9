"""Made-up frames of a tool and a fixture, as `visioncal tcp` and `visioncal fixture` leave them."""

import numpy as np

from visioncal.core.transforms import exp
from visioncal.results import Edge, Frame, FrameFile, Observation, Verdict

TOOL, FIXTURE = "flange_from_tool", "base_from_fixture"
CREATED = "2026-11-20T12:13:14+00:00"
GOOD = Verdict.of("good", "The tip is determined to 0.22 mm.")
FLANGE_FROM_TOOL = exp(np.array([0.1, -0.4, 2.0, 0.0338, 0.001, 0.0768]))
BASE_FROM_FIXTURE = exp(np.array([0.01, 0.02, -1.1, 0.71, -0.33, 0.12]))
# [rad], [m]
COVARIANCE = np.diag([1e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1.5e-4]) ** 2


def frame(matrix, *, oriented=True, verdict=GOOD, source="touches.csv"):
    covariance = COVARIANCE.copy()
    if not oriented:
        covariance[:3], covariance[:, :3] = 0.0, 0.0
    return Frame(
        Edge(matrix, covariance),
        oriented,
        "pivot over 10 touches",
        source,
        CREATED,
        0.21,
        0.1,
        (Observation("1", used=True, kind="point", residual_mm=0.1),),
        verdict,
    )


def tool(matrix=FLANGE_FROM_TOOL, **changes):
    return {TOOL: frame(matrix, **changes)}


def fixture(matrix=BASE_FROM_FIXTURE, **changes):
    return {FIXTURE: frame(matrix, **changes)}


def frame_file(*frames):
    """A file of frames without a calibration."""
    return FrameFile({name: value for some in frames for name, value in some.items()})
