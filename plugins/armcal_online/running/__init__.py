"""A recalibration that runs: its loop, its outputs, and how it is told what to do."""
