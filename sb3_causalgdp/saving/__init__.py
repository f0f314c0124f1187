"""What is in files, and how files of strangers are read."""
