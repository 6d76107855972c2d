"""What happened, for whoever follows it: events as lists, streams and webhooks."""
