"""Meshes, frames, ray acceleration and the procedural shapes."""
