"""Estimators, weights and robust losses, covariance, intervals, folds, bootstrap."""
