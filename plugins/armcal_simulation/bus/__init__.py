"""Smart servos on a serial bus."""
