"""Instructions, sub-goal texts, and their sentence embeddings."""
