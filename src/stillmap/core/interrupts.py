"""Steps that no signal may cut in two: making what is removed later, removing it, exchanging names.

An exception that a signal handler raises between two of them would leave the first without the
second. Handlers of signals ask `defers_signals_in`, and if so `send_again`. Where others handle
Ctrl-C, as in notebooks, the functions are as any.
"""

import contextlib
import signal
import tempfile
import threading
from collections.abc import Callable
from types import CodeType, FrameType
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])

_RETRY = 0.02  # s until a deferred signal is sent again

_deferring = set[CodeType]()
# these start and resume a generator that is a context manager
_generators = {
    contextlib._GeneratorContextManager.__enter__.__code__,
    contextlib._GeneratorContextManager.__exit__.__code__,
}


def defer_signals(function: _Function) -> _Function:
    """Decorator of a short function within which signals wait.

    Of a context manager that is a generator it belongs below `contextmanager`: signals wait before
    and after the block, not within it.
    """
    _deferring.add(function.__code__)
    return function


def defers_signals_in(frame: FrameType | None) -> bool:
    """True if a signal that came in this frame has to wait; frames that called it do not count."""
    if frame is None:
        return False
    code = frame.f_code
    if code in _generators:
        generator = getattr(frame.f_locals.get("self"), "gen", None)
        return getattr(generator, "gi_code", None) in _deferring
    # its temporary folders are made before they are registered, and forgotten before they go
    return code in _deferring or code.co_filename == tempfile.__file__


def send_again(number: int) -> None:
    """Send a signal to the main thread a little later; Python handles signals there alone."""
    main = threading.main_thread().ident
    again = threading.Timer(_RETRY, signal.pthread_kill, (main, number))
    again.daemon = True
    again.start()
