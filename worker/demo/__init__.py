"""The demo: the whole service on a simulated building, and how near it came to the truth."""
