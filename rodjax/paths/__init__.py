"""Many equilibria: paths and batches of scenes, branches, critical points and modes."""
