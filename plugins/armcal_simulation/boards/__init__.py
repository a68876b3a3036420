"""Servo boards with a PCA9685, and the hobby servos that they drive."""
