"""Records that both sides share: tables, blobs, job requests and results; `open_catalog` in catalog.py opens them."""
