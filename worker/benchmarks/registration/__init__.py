"""How well, and how fast, scans become a map: `spicd-worker evaluate registration`."""
