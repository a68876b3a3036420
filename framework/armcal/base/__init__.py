"""Units, arrays, rigid motions, parameter blocks and their domains, datasets, settings."""
