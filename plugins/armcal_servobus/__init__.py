"""Servos on a serial bus: Feetech STS and Dynamixel protocol 2.

The makers' libraries (dynamixel-sdk, ftservo-python-sdk, and feetech-servo-sdk before it) are not used: they share one
layer whose calls give codes in place of errors, wait in a busy loop, and know neither an adapter's echo nor two servos
on one id; two of them claim the same package name, so that only one of these can be installed.
"""
