"""What the user can mend on the command line."""


class CommandError(ValueError):
    """What the user can mend on the command line; the message is one line."""
