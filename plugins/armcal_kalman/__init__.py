"""Online estimators: Kalman filters, and the last records solved together."""
