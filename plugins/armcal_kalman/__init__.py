"""Online estimators: a Kalman filter."""
