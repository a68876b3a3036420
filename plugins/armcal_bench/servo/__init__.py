"""Servo calibration: which pulse makes which angle."""
