"""A detector turns paired tiles into scores."""
