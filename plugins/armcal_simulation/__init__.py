"""A truth to calibrate against."""
