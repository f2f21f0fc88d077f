"""Blobs, artefact files, records and the queue: everything that outlives a process."""

__version__ = "0.1.0"
"""Of the whole project: the service's image holds its sources without the package's metadata."""
