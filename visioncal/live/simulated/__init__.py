"""A simulated UR controller, for the real client library, and a camera that observes its arm."""
