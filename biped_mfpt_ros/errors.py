"""The one error for input that is not allowed."""

from __future__ import annotations

from numbers import Number


class InputError(ValueError):
    """A value given by the user or by another node is not allowed.

    Parameters
    ----------
    field : str
        Name of the field, parameter, option or file that holds the value.
    value : object
        The value itself, None if it is missing; long ones are shortened in the text.
    allowed : str
        What would have been allowed.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        self.field = field
        self.value = value
        self.allowed = allowed
        shown = str(value) if isinstance(value, Number) else repr(value)  # numpy's, too
        if len(shown) > 200:
            shown = shown[:197] + "..."
        problem = "missing" if value is None else f"{shown} is not allowed"
        super().__init__(f"{field}: {problem}; allowed: {allowed}")
