"""Hints of errors, which name arguments of Python, in terms of the command line."""

from stillmap.core.errors import InputError

# argument, as hints name it -> flag
FLAGS = {
    "overwrite=True": "--overwrite",
    "resume=True": "--resume",
    "recording=PATH": "--input",
    "max_dt=SECONDS": "--max-dt",
    "port=0 takes any free one": "without --port any free one is used",
    "name=FORMAT": "--to",
    "frame=": "--frame ",
    "map_state=": "--map-state ",
    "tilting=": "--tilting ",
    "estimator=": "--estimator ",
    'poses="FILE.tum"': "--poses FILE.tum",
    'poses="recording"': "--poses recording",
}


def in_flags(error: InputError) -> InputError:
    """The error with flags in its hint instead of arguments; itself where it names none."""
    hint = error.hint
    for argument, flag in FLAGS.items():
        hint = hint.replace(argument, flag)
    if hint == error.hint:
        return error
    return InputError(error.what, where=error.where, hint=hint)
