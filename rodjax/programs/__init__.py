"""Programs compiled by JAX: how they are made, and kept on disk."""
