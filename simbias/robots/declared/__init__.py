"""Tasks that are declared in YAML."""
