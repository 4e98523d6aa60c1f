"""Training samples for torch."""
