"""The service's own database records."""
