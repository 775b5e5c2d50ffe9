"""Where things are in a recording: the names of its entities, its frames and its timeline.

The frames of the cell are rerun's named frames, each placed on what it hangs on. Of several robots,
cameras or targets, the entities have their names: /cameras/top in the place of /camera.
"""

import rerun as rr

TIMELINE = "view"
APPLICATION = "visioncal"

# The facts of the session, to be read back.
SESSION = "/session"
ROWS = "/session/rows"
STREAMS = "/session/streams"
CORNERS = "/session/corners"
END = "/session/end"
IMAGE = "/camera/image"

# The frames of the cell.
BASE_FRAME, FLANGE_FRAME, CAM_FRAME, TARGET_FRAME = "base", "flange", "cam", "target"
IMAGE_FRAME = "image"

# Results, exact; the calibration's text is written last and makes them count.
CALIBRATION = "/results/calibration"
EVIDENCE = "/results/evidence"

# The cell.
BASE = "/base"
ROBOT = "/robot"
FLANGE = "/flange"
STOPS = "/stops"
CAMERA = "/camera"
TARGET = "/target"
FRAMES = "/frames"
SEEN_TARGET = "/target_as_this_view_sees_it"

# Charts over all views.
COVERAGE = "/coverage"
IMAGE_COVERAGE = f"{COVERAGE}/image"
DIRECTIONS = f"{COVERAGE}/directions"
ROTATION_AXES = f"{COVERAGE}/rotation_axes"

# In the image.
DETECTED = f"{IMAGE}/detected"
PREDICTED = f"{IMAGE}/predicted"
RESIDUALS_TO_SCALE = f"{IMAGE}/residuals_of_views_not_used_to_scale"

# What is explained of it.
DRAWN = "/explained/board_as_it_should_look"
REST = "/explained/not_explained"
BLUR_NOTE = "/notes/blur"

# The calibrated arm.
WORKSPACE = "/arm/workspace"
NOMINAL_ARM = "/arm/as_stated"
UNSEEN_MM = "/arm/unseen/position_mm"
UNSEEN_DEG = "/arm/unseen/orientation_deg"
ARM_NOTE = "/notes/arm"

# Drift with temperature.
DRIFT_MM = "/arm/warming/drift_mm"
RISE_K = "/arm/warming/rise_k"

# A whole cell of several robots: its frame, and who saw whom.
CELL_FRAME = "cell"
CELL = "/cell"
SIGHT_LINE = "/sight"
NETWORK = "/network"
# Where earlier versions kept the text of its result.
ALIGNMENT = "/results/alignment"

# A plan: what is in the way, and how far the joints go.
OBSTACLES = "/obstacles"
WAY = "/way"
WAY_TIMELINE = "way"
PREDICTED_SIGMA = "/plan/sigma_after_so_many_stops_mm"
PLAN_NOTE = "/notes/plan"
STOP_NOTE = "/notes/stop"

# A motion, second by second.
MOTION_TIMELINE = "motion"
MOTION = "/motion"
MOTION_KINDS = ("position_deg", "speed_deg_s", "acceleration_deg_s2", "torque_nm")

# A dynamic identification, on the same timeline.
TORQUES = "/dynamics/torques_nm"
TORQUE_ERRORS = "/dynamics/errors_nm"
SPEEDS = "/dynamics/speeds_rad_s"
DYNAMICS_NOTE = "/notes/dynamics"
PARAMETERS_NOTE = "/notes/parameters"
MEASURED_TORQUE, PREDICTED_TORQUE, KNOWN_TORQUE = "measured", "predicted", "known_before"

# A recording at work.
LIVE_SIGMA = "/live/predicted_sigma_mm"
LIVE_NOTE = "/notes/recording"

# Plots and text.
RESIDUALS = "/residuals"
POSITION_MM = f"{RESIDUALS}/position_mm"
ORIENTATION_DEG = f"{RESIDUALS}/orientation_deg"
REPROJECTION_PX = f"{RESIDUALS}/reprojection_px"
VERDICT = "/notes/verdict"
# A strip in the verdict's colour: texts have none.
VERDICT_STRIP = "/verdict_strip"
FIGURES = "/notes/figures"
SOLVERS = "/notes/solvers"
TOOLS = "/notes/tools_and_fixtures"
VIEW_NOTE = "/notes/view"
USED, REJECTED, THIS_VIEW = "used", "rejected", "this_view"
# Drawn where the scale ends, because it lies farther out.
BEYOND = "rejected_beyond_the_scale"


_ENTITIES = {BASE_FRAME: BASE, FLANGE_FRAME: FLANGE, CAM_FRAME: CAMERA, TARGET_FRAME: TARGET}


def entity_of(frame: str) -> str:
    """The entity of a frame: a robot's base or flange, a camera's, a target's, a tool's."""
    kind, _, name = frame.partition("_")
    if kind in _ENTITIES:
        return named(_ENTITIES[kind], name)
    return f"{FRAMES}/{rr.escape_entity_path_part(frame)}"


def named(entity: str, name: str) -> str:
    """The entity of one of several things by its name: /robots/a of /robot; of an only one, it."""
    return f"{entity}s/{rr.escape_entity_path_part(name)}" if name else entity


def image_frame(camera: str) -> str:
    """The frame of the images of a camera, by its frame."""
    return IMAGE_FRAME if camera == CAM_FRAME else f"{IMAGE_FRAME}_of_{camera}"


def part_of(plot: str, name: str) -> str:
    """The part of a plot that is of one camera or robot by its name; of an only one, the plot."""
    return f"{plot}/{rr.escape_entity_path_part(name)}" if name else plot


def magnified_residuals(factor: int) -> str:
    """The entity of residuals that are drawn `factor` times longer than they are."""
    return f"{IMAGE}/residuals_magnified_{factor}x"


def magnified_arm(factor: int) -> str:
    """The entity of the arm as stated, drawn `factor` times farther off than it is."""
    return f"{NOMINAL_ARM}/off_magnified_{factor}x"


def over_joint(joint: int) -> str:
    """The entity of the residuals over the angle of a joint, which is counted from 0."""
    return f"{RESIDUALS}/over_joints/q{joint + 1}"


def of_joint(group: str, joint: int) -> str:
    """The entity of a joint, which is counted from 0, within a group over time."""
    return f"{group}/joint_{joint + 1}"
