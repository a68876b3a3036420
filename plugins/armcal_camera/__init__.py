"""Cameras: boards seen by a camera that an arm carries, or that watches an arm."""
