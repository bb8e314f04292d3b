"""The process that serves: answers and parts of the map come in, lines about itself go out."""

import json
import logging
import sys
import threading
from typing import IO

from stillmap.core.errors import InputError, MissingExtra, import_extra
from stillmap.core.extras import install_command
from stillmap.live.child_process import serve
from stillmap.live.foxglove.answer import unpack_answer, unpack_changes
from stillmap.live.foxglove.mailbox import Mailbox
from stillmap.live.messages import read_message


def _receive(stream: IO[bytes], mailbox: Mailbox) -> None:
    """Put what arrives into the mailbox until the stream ends."""
    try:
        while (arrays := read_message(stream)) is not None:
            if "begins_anew" in arrays:
                mailbox.begin_anew()
            elif "first_cell" in arrays:
                mailbox.put_changes(unpack_changes(arrays), float(arrays["resolution"]))
            elif "path" in arrays:
                mailbox.put_path(arrays["path"])
            else:
                mailbox.put_answer(unpack_answer(arrays))
    finally:
        mailbox.close()


def _publish(host: str, port: int) -> None:
    """Publish what arrives until the other process has ended or has no more to say.

    Raises:
        InputError: the library is missing, or nobody can be served there.
    """
    import_extra("foxglove", "the live view", "served", group="live")
    try:
        from stillmap.live.foxglove.publisher import Publisher
    except ImportError as error:  # of another version
        what = f"this foxglove-sdk cannot be used: {error}"
        raise InputError(what, hint=install_command("live")) from error

    mailbox = Mailbox()
    publisher = Publisher(host, port, mailbox.wake)
    _tell(port=publisher.port)
    threading.Thread(target=_receive, args=(sys.stdin.buffer, mailbox), daemon=True).start()
    is_watched = False
    while (mail := mailbox.take(publisher.due)) is not None:
        publisher.publish(mail)
        if publisher.is_watched != is_watched:
            is_watched = not is_watched
            _tell(is_watched=is_watched)
    publisher.stop()


def _tell(**content: object) -> None:
    sys.stdout.write(json.dumps(content) + "\n")
    sys.stdout.flush()


def _work() -> None:
    logging.disable()  # about each client whose request is malformed
    try:
        _publish(sys.argv[1], int(sys.argv[2]))
    except InputError as error:
        is_missing = isinstance(error, MissingExtra)
        _tell(what=error.what, where=error.where, hint=error.hint, is_missing=is_missing)


if __name__ == "__main__":
    serve(_work)
