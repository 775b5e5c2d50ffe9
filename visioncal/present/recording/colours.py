"""Colours of a recording, the same in the cell and the images."""

USED = (70, 150, 250)
REJECTED = (230, 70, 60)
# The way; it contrasts with the others on dark and on light backgrounds.
WAY = (250, 165, 30)
# By the verdict's status, as in the report.
VERDICT = {"good": (26, 122, 56), "check": (226, 173, 69), "bad": (194, 43, 38)}

LINK = (186, 193, 204)
JOINT = (68, 80, 100)
DETECTED = (50, 220, 110)
PREDICTED = (80, 160, 255)
RESIDUAL = (255, 70, 60)

# Background lines.
GRID = (128, 134, 146)
