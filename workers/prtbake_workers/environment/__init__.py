"""Distant light: reading, layouts, sampling, fitting, procedural skies."""
