"""Where doubt begins and where trust ends, in one table: (check, bad) limits."""

# Predicted sigma of a place that a camera gives [mm]: pick cells live with 1 mm.
PLACE_MM = (1.0, 3.0)
# The same of a rotation [deg]: 0.1 deg moves a point 0.5 m away by 1 mm.
TURN_DEG = (0.1, 0.3)
# Predicted sigma of a place that is touched [mm]: a careful hand repeats to 0.1 mm or better.
TOUCHED_MM = (0.5, 2.0)
# Noise of a touch per axis [mm], for the same reason.
TOUCH_NOISE_MM = (0.5, 3.0)
# Predicted sigma of the rotation of what is small: a tool, or one board [deg].
SMALL_TURN_DEG = (0.3, 1.0)
