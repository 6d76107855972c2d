"""How well changes are found: the figures and the rivals that every benchmark of detection uses."""
