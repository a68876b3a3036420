"""What the data could and could not determine: residual structure, suspects, the verdict."""
