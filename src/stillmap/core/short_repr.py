"""Short `repr` of dataclasses that hold arrays: shapes and types instead of numbers."""

import dataclasses
from collections.abc import Mapping
from typing import Any

_MAX_LENGTH = 60  # characters of a value


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
    if shape is not None and dtype is not None:
        return repr(value.item()) if shape == () else f"<{dtype} {tuple(shape)}>"
    if isinstance(value, ShortRepr) or dataclasses.is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, Mapping | list | set | frozenset) or (
        isinstance(value, tuple) and len(value) > 4
    ):
        return f"<{type(value).__name__} of {len(value)}>" if len(value) else repr(value)
    text = repr(value)
    return text if len(text) <= _MAX_LENGTH else f"<{type(value).__name__}>"
