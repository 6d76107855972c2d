"""What each model says of real scans, as they are and with things put into them: `spicd-worker evaluate real`."""
