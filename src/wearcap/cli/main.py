"""`wearcap VERB …`: finds the verb's module, runs it, and turns errors that users can fix into one message."""

import errno
import importlib
import os
import re
import sys
import traceback
from argparse import ArgumentParser
from collections.abc import Callable
from typing import Any

from wearcap.boundary.limits import VARIABLE, gib_bytes
from wearcap.boundary.own import trusting
from wearcap.cli.verbs import VERBS, conf_dir, help_of, overrides
from wearcap.errors import WearcapError, nearest
from wearcap.extras import check_verb
from wearcap.version import __version__

USER_ERROR, INTERRUPTED = 2, 130


def usage() -> str:
    """The help text: every verb with its line."""
    lines = [
        "wearcap: motion capture from what a person wears.",
        "",
        "usage: wearcap VERB key=value …     wearcap VERB --help     wearcap --version",
        "",
        *(f"  {verb:10} {line}" for verb, line in VERBS.items()),
        "",
        "debug=true shows the traceback of an error.",
        "trust=true opens .ckpt and .pt2 files from elsewhere, which can run code: for",
        "files that are your own. max_file_gib=N reads files of up to N GiB once",
        "unpacked, however tightly packed: for files that you trust.",
        "All settings go as key=value or as --key value, as you like.",
    ]
    return "\n".join(lines)


def run_verb(verb: str, arguments: list[str], application: Callable[[], Any] | None = None) -> int:
    """Run one verb and return the exit code; errors that a user can fix become one message on stderr.

    `application` is a script's own of `hydra.main`, with which its verb runs.
    """
    debug, trust = (bool({f"{key}=true", f"--{key}"} & set(arguments)) for key in ("debug", "trust"))
    own = re.compile(r"(--)?(debug|trust)=(true|false)|--(debug|trust)")  # of every verb
    arguments = [word for word in arguments if not own.fullmatch(word)]
    try:
        if {"--help", "-h"} & set(arguments) and (text := help_of(verb, arguments)):
            print(text)
            return 0
        module = verb
        if verb == "scene" and arguments[:1] == ["edit"]:
            module, arguments = "scene_edit", arguments[1:]
        elif (conf_dir() / f"{verb}.yaml").is_file():
            arguments = overrides(verb, arguments)
        check_verb(module)
        with trusting(trust):
            importlib.import_module(f"wearcap.cli.{module}").main(arguments, *([application] if application else []))
        return 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `wearcap … | head`: the reader left
        sys.stderr.close()
        return 1
    except (WearcapError, OSError) as error:
        if debug:
            traceback.print_exc()
        print(f"wearcap {verb}: {explain(error)}", file=sys.stderr)
        return USER_ERROR


def explain(error: WearcapError | OSError) -> str:
    """One message: a WearcapError's own, or the operating system's error with its path."""
    if isinstance(error, WearcapError):
        return str(error)
    where = f"{error.filename}: " if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"{where}the disk is full. Free some space and run again."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{where}no permission. Choose another folder."
    return f"{where}{error.strerror or error}."


def port_number(text: str) -> int:
    """Type of a page's `--port` argument. Raises WearcapError for a number that is no port."""
    number = int(text)
    if not 0 < number < 65536:
        raise WearcapError(f"port {number}", expected="1 to 65535")
    return number


def add_page(parser: ArgumentParser, port: int, host: bool = False) -> None:
    """Add the options `--port`, and `--host` if the page can be served to other machines."""
    text = f"port of the page (default {port}, else the next free)"
    parser.add_argument("--port", type=port_number, default=port, help=text)
    if host:
        text = "address to serve on (default: this machine only)"
        parser.add_argument("--host", default="127.0.0.1", help=text)


def main(arguments: list[str] | None = None) -> None:
    """The console command. Exits with 0, 2 (an error that a user can fix) or 130 (interrupted)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        option = re.compile(r"--max[-_]file[-_]gib(=|$)|max_file_gib=")
        place = next((i for i, word in enumerate(arguments) if option.match(word)), None)
        if place is not None:  # the limit of file sizes, for worker processes too
            word, *rest = arguments[place:]
            value = word.partition("=")[2] if "=" in word else rest.pop(0) if rest else ""
            gib_bytes(value, "max_file_gib")
            os.environ[VARIABLE] = value
            arguments = arguments[:place] + rest
    except WearcapError as error:
        print(f"wearcap: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    verb = next((word for word in arguments if not word.startswith("-") and word != "debug=true"), None)
    if arguments[:1] == ["--version"]:
        print(f"wearcap {__version__}")
    elif verb is None or arguments[0] in ("--help", "-h"):
        print(usage())
        sys.exit(0 if arguments else USER_ERROR)
    elif verb not in VERBS:
        print(f"wearcap: no verb {verb!r}. {nearest(verb, VERBS)}", file=sys.stderr)
        sys.exit(USER_ERROR)
    else:
        place = arguments.index(verb)
        sys.exit(run_verb(verb, arguments[:place] + arguments[place + 1 :]))


if __name__ == "__main__":
    main()
