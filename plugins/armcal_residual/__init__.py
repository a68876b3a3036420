"""Pose residuals: what the physical model of an arm leaves, as a smooth function of the pose."""
