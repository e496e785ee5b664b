"""Routes of cables: what they shall keep to, by how much they do, and where clips and ends make the best of it."""
