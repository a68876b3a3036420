"""LeRobot: motor calibration files, recorded data sets, and what both say of an arm."""
