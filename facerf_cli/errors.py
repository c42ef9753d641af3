"""Errors that a user can cause; each message is one line that says what to do."""


class FacerfError(Exception):
    """An error that the user can correct; the command line prints it in one line and exits with 1."""


class InputError(FacerfError):
    """One input is missing, broken or unsuitable; the run continues with the others."""


class UsageError(FacerfError):
    """The command line is wrong, or there is nothing to work on; the exit code is 2."""
