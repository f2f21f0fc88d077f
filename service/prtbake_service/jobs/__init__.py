"""Submitting, watching and ending jobs."""
