"""Registration; imports nothing heavy."""
