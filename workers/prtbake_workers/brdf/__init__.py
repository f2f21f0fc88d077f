"""Reflectance models and their factorisation; one model a file."""
