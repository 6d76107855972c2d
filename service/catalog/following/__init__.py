"""What happened, in the order of its publication, and who is told."""
