"""Vectors, rotations and curves, of no rod in particular."""
