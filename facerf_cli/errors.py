"""What a user can cause: each error prints as one line that says what to do."""


class FacerfError(Exception):
    """Something the user can mend; the command line prints it in one line and exits 1."""


class InputError(FacerfError):
    """One input item is missing, broken or unsuitable; the other items go on."""


class UsageError(FacerfError):
    """The command was called wrongly, or there is nothing to work on; exit 2."""
