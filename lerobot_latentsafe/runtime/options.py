"""Numbers that people give, refused where they mean nothing, before any work is done."""


def require_at_least(option: str, value: float | None, least: float) -> None:
    """Refuse an option below its least value, or NaN; None is whatever the default is.

    Raises:
        ValueError: naming the option, such as `--steps`.
    """
    if value is not None and not value >= least:
        raise ValueError(f"{option} is {value}; expected at least {least}")
