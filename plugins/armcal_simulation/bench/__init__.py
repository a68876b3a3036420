"""The simulated bench: time, arm, servos, board, tracker, faults, and what counts as unsafe."""
