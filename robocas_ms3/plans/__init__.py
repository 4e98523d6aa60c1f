"""Datasets of any size from a plan: what they are made of, done in units by any engine, and joined."""
