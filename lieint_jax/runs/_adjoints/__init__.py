"""Derivatives of whole runs: by checkpoints, by undoing steps, transition matrices."""
