"""What all that draws needs."""

from .errors import UserError


def require_matplotlib(use: str) -> None:
    """UserError where matplotlib is not installed; `use` begins its message, as in "a report needs"."""
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise UserError(f"{use} matplotlib: pip install 'jaxhf[plot]'") from error
