"""Arm models, joint effects, statics, joint limits, clearance."""
