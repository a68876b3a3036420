"""Joint effects: servos, gears and springs, for any arm model."""
