"""Short `repr` of dataclasses that hold arrays: shapes and types instead of numbers."""

import dataclasses
from typing import Any

_MAX_LENGTH, _MAX_ITEMS = 60, 4  # characters of a value, items that are shown


class ShortRepr:
    """Base of dataclasses whose `repr` is one line, however large their arrays are.

    A class of its own `__repr__` hands it on to its subclasses.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # `dataclass` makes one where the class itself has none
        cls.__repr__ = cls.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        values = (
            f"{field.name}={_describe(getattr(self, field.name))}"
            for field in dataclasses.fields(self)  # type: ignore[arg-type]
            if field.repr
        )
        return f"{type(self).__name__}({', '.join(values)})"


def _describe(value: Any) -> str:
    """A value in a few characters."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape and dtype is not None:
        return f"<{dtype} {tuple(shape)}>"
    if isinstance(value, list | dict | tuple | set | frozenset) and len(value) > _MAX_ITEMS:
        return f"<{type(value).__name__} of {len(value)}>"
    if dataclasses.is_dataclass(value):
        return f"{type(value).__name__}(...)"
    text = repr(value.item() if shape == () else value)
    return text if len(text) <= _MAX_LENGTH else f"<{type(value).__name__}>"
