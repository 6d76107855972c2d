"""The stages, one noun a file; flow.py reads like the paper. Knows no queue and no catalog."""
