"""The base of every error that a user can mend, and a check of settings."""


class UserError(Exception):
    """Something the user can mend: the message says what was seen, where, and what to change.

    The entry points print the message alone and exit with 1; everything else is a defect and keeps its stack trace.
    """


def require_positive(part: str, **settings: float | int | None) -> None:
    """Raise a ValueError unless all settings of a part are numbers above 0."""
    wrong = ", ".join(f"{name}={value}" for name, value in settings.items() if value is None or not value > 0)
    if wrong:
        raise ValueError(f"{part}: {' and '.join(settings)} must be above 0, got {wrong}")
