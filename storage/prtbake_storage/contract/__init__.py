"""Wire models shared by service, workers and SDK."""
