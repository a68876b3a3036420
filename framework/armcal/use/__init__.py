"""Fifth floor: what a calibration is used for."""
