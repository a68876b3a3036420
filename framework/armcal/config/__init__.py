"""From YAML to checked settings and built components."""
