"""Makers' calibrations: what a robot's maker measured of it, read as a URDF, compared, and written back."""
