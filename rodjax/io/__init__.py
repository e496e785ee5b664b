"""Files: scenes, quantities with units, results."""
