"""From a session to a result: its stages, the driver, the reading of poses."""
