"""What surveys found, from visit to visit: changes, objects, their history."""
