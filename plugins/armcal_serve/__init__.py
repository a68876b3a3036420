"""Serving a calibration, which may be replaced at any time, to other programs: requests as JSON lines."""
