"""The one exception that stands for bad input or a bad call."""


class InputError(Exception):
    """Input or call at fault: says what is wrong, where, and what to do.

    The command line prints it as one line and exits with status 2.

    Args:
        what: what is wrong.
        where: file and position (`log.clf:17`), empty when there is none.
        hint: what the user can do about it, empty when there is nothing to add.
    """

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        self.what = what
        self.where = where
        self.hint = hint
        super().__init__(str(self))

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        advice = f" ({self.hint})" if self.hint else ""
        return f"{place}{self.what}{advice}".replace("\n", " ")
