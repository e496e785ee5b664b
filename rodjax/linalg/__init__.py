"""Linear systems of small blocks along the rod, with a border."""
