"""Recordings of ROS 2 without ROS, and a node that feeds a running recalibration."""
