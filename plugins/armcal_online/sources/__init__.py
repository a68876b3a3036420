"""Where records come from, one at a time."""
