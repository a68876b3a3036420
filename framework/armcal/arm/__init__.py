"""First floor: arm models, joint effects, statics."""
