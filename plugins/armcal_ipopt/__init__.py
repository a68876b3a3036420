"""The constrained fit by IPOPT."""
