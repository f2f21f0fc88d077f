"""Meshes, BRDFs and environments."""
