"""Arm models from URDF files, and calibrated arms written back into them."""
