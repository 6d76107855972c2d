"""What comes in: bodies, fields, codings, digests, keys of retries."""
