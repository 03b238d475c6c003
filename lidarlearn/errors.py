"""The base of every error that a user can mend."""


class UserError(Exception):
    """Something the user can mend: the message says what was seen, where, and what to change.

    The entry points print the message alone and exit with 1; everything else is a defect and keeps its stack trace.
    """
