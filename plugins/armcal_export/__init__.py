"""Calibrated arms for other programs: C code, self-describing YAML and JSON, MuJoCo models."""
