"""What a user describes: a rod, what holds, loads and touches it, and the scene of them all. Nothing here is solved."""
