"""Tools, fixtures and picks: level 6, on top of a calibration."""
