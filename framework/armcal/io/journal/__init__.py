"""The durable journal: what was acknowledged outlives kills and power cuts."""
