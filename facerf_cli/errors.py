"""Errors that a user can cause; each message is one line that says what to do."""


class FacerfError(Exception):
    """Error that the user can correct; the command line prints it in one line and exits with 1."""


class InputError(FacerfError):
    """Error of one input, which is missing, broken or unsuitable; the run continues with the others."""


class UsageError(FacerfError):
    """Error of the command line, or a run without inputs; the exit code is 2."""
