"""A robot's side: what it recorded, what lies beside its files, and how they are sent."""
