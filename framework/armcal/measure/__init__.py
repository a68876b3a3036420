"""Second floor: what a record measures, and how records are read."""
