"""Arm models from Denavit-Hartenberg rows with extra transforms before and after any row."""
