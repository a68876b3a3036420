"""Serving a calibration to other programs: requests as JSON lines, answered by a worker that is replaced in flight."""
