"""The bench: servo boards, trackers, and measuring runs that cannot hurt the arm."""
