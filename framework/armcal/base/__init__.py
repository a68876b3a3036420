"""Ground floor: units, rigid motions, parameters, datasets."""
