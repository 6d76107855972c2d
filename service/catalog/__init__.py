"""Records that both sides share: tables, blobs, job requests and results."""
