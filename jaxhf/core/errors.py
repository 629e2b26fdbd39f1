"""Errors that are not jaxhf's own: what a caller, or the author of a file, got wrong."""


class UserError(ValueError):
    """A mistake in an argument or a file. The command line shows it as one line; any other ValueError keeps its traceback."""


class ArgumentError(UserError):
    """A value that an argument cannot have: "Perspective: fov must lie between 0 and 180 degrees, it is 200.0".

    Attributes:
      argument: the argument's name as a caller writes it: "fov", "targets[2]".
      rule: what the message says after that name.
    """

    def __init__(self, owner: str, argument: str, rule: str):
        """
        Args:
          owner: the function or class whose argument it is, the first word of the message; "": none.
          argument, rule: the attributes. A rule that begins with a colon follows the name without a space.
        """
        place = f"{owner}: {argument}" if owner else argument
        super().__init__(f"{place}{rule}" if rule.startswith(":") else f"{place} {rule}")
        self.argument = argument
        self.rule = rule.removeprefix(": ")
