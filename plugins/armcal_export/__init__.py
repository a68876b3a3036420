"""Calibrated arms for other programs: C code, self-describing YAML and JSON, ROS 2 parameters, MuJoCo models."""
