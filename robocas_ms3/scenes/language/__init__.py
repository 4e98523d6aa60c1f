"""Instructions, texts of sub-goals, and their sentence embeddings."""
