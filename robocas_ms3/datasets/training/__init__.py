"""Training samples for PyTorch."""
