"""How good and how fast it is, measured; nothing in production imports it."""
