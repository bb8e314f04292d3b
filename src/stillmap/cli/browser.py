"""The browser of whoever sits here."""

import os
import sys
import threading


def has_screen() -> bool:
    """Whether there is one to open: without a screen it would be one of text in the terminal."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform == "darwin" or any(os.environ.get(name) for name in screens)


def opened(address: str) -> bool:
    """Open an address; whether that went well. Some browsers come back when they are closed."""
    if not has_screen():
        return False
    import webbrowser

    return webbrowser.open(address)


def opened_beside(address: str) -> bool:
    """The same without waiting for it; whether there is a screen."""
    if has_screen():
        threading.Thread(target=opened, args=(address,), daemon=True).start()
        return True
    return False
