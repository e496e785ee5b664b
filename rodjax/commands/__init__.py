"""What each command of `rodjax` does, with the arguments that `cli` has read; it returns the exit code."""
