"""What makes it fast, and nothing else: without all of it, the numbers are the same up to rounding."""
