"""Third floor: problems, their compiled functions, estimators, identifiability, validation."""
