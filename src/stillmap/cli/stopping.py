"""Ctrl-C and SIGTERM: an exception in the main thread, but none while a module is being imported.

A library that is just being imported may take the exception for a missing module and go on
without it, may turn it into an error of its own, or may execute text as code, after which Python
believes that nobody caught the interrupt. So the signal is sent again until the import is over.
Likewise while points are packed as LAZ: an exception on the way to the file becomes another one.
"""

import signal
import sys
import threading
from types import CodeType, FrameType

EXIT_INTERRUPTED, EXIT_TERMINATED = 130, 143

_SOON = 0.02  # s until a signal that came at a bad moment is sent again
_IMPORTS = "<frozen importlib"  # where Python says that the code of its imports is
_PACKING = "lazrsbackend.py"  # of laspy


def hear_signals(command: CodeType) -> None:
    """From now on Ctrl-C raises KeyboardInterrupt, and SIGTERM SystemExit, within `command`.

    Both leave through the clean-up of any exception: temporary folders go. Ctrl-C that was
    ignored when we began, as in the background of a shell script, stays ignored.
    """

    main = threading.get_ident()  # Python hears signals in it alone

    def heard(number: int, frame: FrameType | None) -> None:
        if _is_at_a_bad_moment(frame, command):
            again = threading.Timer(_SOON, signal.pthread_kill, (main, number))
            again.daemon = True
            again.start()
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            sys.exit(EXIT_TERMINATED)

    signal.signal(signal.SIGTERM, heard)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, heard)


def _is_at_a_bad_moment(frame: FrameType | None, command: CodeType) -> bool:
    while frame is not None and frame.f_code is not command:
        name = frame.f_code.co_filename
        if name.startswith(_IMPORTS) or name.endswith(_PACKING):
            return True
        frame = frame.f_back
    return False
