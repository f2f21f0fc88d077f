"""Blobs on their way in."""
