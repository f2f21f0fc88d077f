"""Whether and how the service runs."""
