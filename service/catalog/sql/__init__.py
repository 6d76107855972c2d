"""The tables, and the database that they are in."""
