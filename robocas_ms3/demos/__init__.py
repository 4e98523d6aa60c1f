"""Demonstrations: recording, generation over seeds and workers, the ledger of failures, replay."""
