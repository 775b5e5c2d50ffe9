"""The colours of a recording, the same in the cell, the images and the charts."""

USED = (70, 150, 250)
REJECTED = (230, 70, 60)
# Stands out from the others on dark and on light ground.
THIS_VIEW = (250, 165, 30)

LINK = (186, 193, 204)
JOINT = (68, 80, 100)
DETECTED = (50, 220, 110)
PREDICTED = (80, 160, 255)
RESIDUAL = (255, 70, 60)
UNCERTAINTY = (190, 120, 255)

# Lines and words of the charts that viewers should not look at first.
GRID = (128, 134, 146)
WORDS = (140, 146, 158)
