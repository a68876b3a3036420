"""Arm models as products of exponentials: one screw a joint, all in the base frame."""
