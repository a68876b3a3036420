"""Sixth floor: from a configuration to a finished run."""
