"""Sends events to webhooks: which addresses may be reached, one signed request, and who makes it when."""
