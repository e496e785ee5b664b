"""Discretizations of the rod: each turns a scene into a finite energy and reads results off its unknowns."""
