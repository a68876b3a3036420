"""A simulated mission, judged against its truth."""
