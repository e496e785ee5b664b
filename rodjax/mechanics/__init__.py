"""Strains, energy and contact at a place of the rod, on no mesh."""
