"""PCA9685 servo boards, and the links that reach them: Linux I2C, and framed serial lines."""
