"""Factors and parameters become a compiled least-squares problem."""
