"""Who and what may pass: access, origins, methods, and how many at a time."""
