"""The parameters of a nominal model, identified from experiments."""
