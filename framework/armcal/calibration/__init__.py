"""What a run leaves behind: load, predict, intervals, compensate, convert, export."""
