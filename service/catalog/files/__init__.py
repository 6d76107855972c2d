"""What is kept as files: where, under which names, for how long, and copies of it."""
