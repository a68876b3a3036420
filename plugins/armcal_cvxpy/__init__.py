"""The constrained fit by sequential convex steps."""
