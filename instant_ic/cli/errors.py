"""The error that a command raises for a problem that the user can solve."""


class UserError(Exception):
    """An error that is printed as one line without a traceback; the process exits with ``status``."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status
