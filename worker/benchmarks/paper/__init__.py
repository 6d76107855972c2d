"""The benchmark of the paper, Sections 4 and 5, on a simulated corridor: `spicd-worker evaluate paper`."""
