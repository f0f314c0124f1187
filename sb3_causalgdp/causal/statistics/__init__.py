"""What discovery keeps of transitions, and the linear algebra on it."""
