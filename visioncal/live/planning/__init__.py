"""Planning: which stops of the robot tell most, among those that it can reach and look from."""
