"""Blobs, artefact files, records and the queue: everything that outlives a process."""
