"""Tasks declared in YAML."""
