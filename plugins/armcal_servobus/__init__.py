"""Servos on a serial bus: Feetech STS and Dynamixel protocol 2.

The makers' libraries are not used: they give codes in place of errors, wait in a busy loop, and know neither an
adapter's echo nor two servos on one id; two of them claim one package name, so that only one can be installed.
"""
