"""Minimisers of a discretized energy."""
