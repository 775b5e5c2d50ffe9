"""A simulated cell that the real client libraries talk to."""
