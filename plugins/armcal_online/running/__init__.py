"""A recalibration that runs: its loop, its outputs, and its control socket."""
