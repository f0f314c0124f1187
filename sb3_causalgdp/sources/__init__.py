"""Recorded transitions as they lie in files and data frames, read once for discovery and for offline training."""
