"""Compensation: what to command so that the real arm, with its springs, its play and its counts, arrives."""
