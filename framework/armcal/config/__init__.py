"""Fourth floor: from text to checked settings and built components."""
