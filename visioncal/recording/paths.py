"""Where things are in a recording: the names of its entities and of its timeline.

Everything in 3D is logged in the robot's base frame, which is the root.
"""

TIMELINE = "view"
APPLICATION = "visioncal"

# The facts of the session, to be read back.
SESSION = "/session"
ROWS = "/session/rows"
IMAGE = "/camera/image"

# Results, exact.
CALIBRATION = "/results/calibration"
EVIDENCE = "/results/evidence"

# The cell.
BASE = "/base"
ROBOT = "/robot"
FLANGE = "/flange"
STOPS = "/stops"
CAMERA = "/camera"
TARGET = "/target"
SEEN_TARGET = "/target_as_this_view_sees_it"

# In the image.
DETECTED = f"{IMAGE}/detected"
PREDICTED = f"{IMAGE}/predicted"

# Plots and text.
RESIDUALS = "/residuals"
POSITION_MM = f"{RESIDUALS}/position_mm"
ORIENTATION_DEG = f"{RESIDUALS}/orientation_deg"
REPROJECTION_PX = f"{RESIDUALS}/reprojection_px"
VERDICT = "/notes/verdict"
SOLVERS = "/notes/solvers"
VIEW_NOTE = "/notes/view"
USED, REJECTED = "used", "rejected"


def magnified_residuals(factor: int) -> str:
    """The entity of residuals that are drawn `factor` times longer than they are."""
    return f"{IMAGE}/residuals_magnified_{factor}x"
