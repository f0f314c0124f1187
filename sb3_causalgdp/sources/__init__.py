"""Recorded transitions as they lie in files, buffers and data frames, read once for discovery and for offline training."""
