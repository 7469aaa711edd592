"""What a command raises when the user can do something about it."""


class UserError(Exception):
    """Told in one line, without a trace; the process ends with ``status``."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status
