"""Clustered compression of transfer data."""
