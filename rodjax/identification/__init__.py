"""Parameters of rods and rigs from measurements."""
