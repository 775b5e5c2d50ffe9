"""Names of a recording's entities, frames and timelines.

The frames of the cell are rerun's named frames, each placed on its parent. With several robots,
cameras or targets, entities carry names: /cameras/top instead of /camera.
"""

import rerun as rr

TIMELINE = "view"
APPLICATION = "visioncal"

# The session's data and its result, to be read back.
SESSION = "/session"
IMAGE = "/camera/image"
CALIBRATION = "/results/calibration"

# The frames of the cell.
BASE_FRAME, FLANGE_FRAME, CAM_FRAME, TARGET_FRAME = "base", "flange", "cam", "target"
IMAGE_FRAME = "image"

# The cell.
BASE = "/base"
ROBOT = "/robot"
FLANGE = "/flange"
STOPS = "/stops"
CAMERA = "/camera"
TARGET = "/target"
FRAMES = "/frames"
SEEN_TARGET = "/target_as_this_view_sees_it"

# In the image.
DETECTED = f"{IMAGE}/detected"
PREDICTED = f"{IMAGE}/predicted"
DEPTH = f"{IMAGE}/depth_too_long_red_too_short_blue"
RESIDUALS_TO_SCALE = f"{IMAGE}/residuals_of_views_not_used_to_scale"

# A cell of several robots: its frame, and who saw whom.
CELL_FRAME = "cell"
CELL = "/cell"
NETWORK = "/network"

# A plan: obstacles, and the path of the arm.
OBSTACLES = "/obstacles"
WAY = "/way"
WAY_TIMELINE = "way"
PLAN_NOTE = "/notes/plan"
STOP_NOTE = "/notes/stop"

# A motion over time.
MOTION_TIMELINE = "motion"

# Plots and text.
RESIDUALS = "/residuals"
POSITION_MM = f"{RESIDUALS}/position_mm"
ORIENTATION_DEG = f"{RESIDUALS}/orientation_deg"
REPROJECTION_PX = f"{RESIDUALS}/reprojection_px"
VERDICT = "/notes/verdict"
# A strip in the verdict's colour, as texts have no background colour.
VERDICT_STRIP = "/verdict_strip"
VIEW_NOTE = "/notes/view"
USED, REJECTED = "used", "rejected"
# Beyond the scale, and drawn at its end.
BEYOND = "rejected_beyond_the_scale"


_ENTITIES = {BASE_FRAME: BASE, FLANGE_FRAME: FLANGE, CAM_FRAME: CAMERA, TARGET_FRAME: TARGET}


def entity_of(frame: str) -> str:
    """Entity of a frame: a robot's base or flange, a camera, a target, a tool."""
    kind, _, name = frame.partition("_")
    if kind in _ENTITIES:
        return named(_ENTITIES[kind], name)
    return f"{FRAMES}/{rr.escape_entity_path_part(frame)}"


def named(entity: str, name: str) -> str:
    """Entity of one of several things by name: /robots/a for /robot; unchanged without a name."""
    return f"{entity}s/{rr.escape_entity_path_part(name)}" if name else entity


def image_frame(camera: str) -> str:
    """Image frame of a camera, by the camera's frame."""
    return IMAGE_FRAME if camera == CAM_FRAME else f"{IMAGE_FRAME}_of_{camera}"


def part_of(plot: str, name: str) -> str:
    """Part of a plot for one camera or robot by name; the plot itself for an empty name."""
    return f"{plot}/{rr.escape_entity_path_part(name)}" if name else plot


def magnified_residuals(factor: int) -> str:
    """Entity of residuals drawn `factor` times longer."""
    return f"{IMAGE}/residuals_magnified_{factor}x"
