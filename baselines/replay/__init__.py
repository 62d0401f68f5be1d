"""Replay: stored, relabelled or imagined transitions."""
