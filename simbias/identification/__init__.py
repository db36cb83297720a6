"""What is learned of the nominal model's parameters."""
