"""Planning: the most informative stops among those that the robot can reach and look from."""
