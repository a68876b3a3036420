"""Watching a recalibration: a page in the browser, or a terminal. It only reads."""
