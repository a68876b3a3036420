"""What every simulated bench has: time, arm, servos, tracker, line, faults, and what counts as unsafe."""
