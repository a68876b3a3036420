"""Recalibration while the arm works: records one at a time, a journal, an updated calibration."""
