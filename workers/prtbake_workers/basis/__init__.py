"""Spherical bases: evaluation, Gram matrices, product integrals."""
