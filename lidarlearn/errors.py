"""The base class of errors that users can fix, and a check of settings."""


class UserError(Exception):
    """An error that the user can fix. The message says what was found, where, and what to change.

    The commands print the message alone and exit with 1. Any other exception is a bug and keeps its stack trace.
    """


def require_positive(part: str, **settings: float | int | None) -> None:
    """Raise a `ValueError` unless all settings of a part are positive numbers."""
    wrong = ", ".join(f"{name}={value}" for name, value in settings.items() if value is None or not value > 0)
    if wrong:
        raise ValueError(f"{part}: {' and '.join(settings)} must be above 0, got {wrong}")
