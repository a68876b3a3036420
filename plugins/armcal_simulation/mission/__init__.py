"""A rover's arm over some days, and what befalls it."""
