"""The verbs, their help and their one style of arguments, without the imports of a verb: help is there at once."""

import argparse
import ast
import functools
import importlib.util
import itertools
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from wearcap.errors import WearcapError, nearest
from wearcap.files import resource

VERBS = {
    "train": "train a model: experiment=motion_diffusion_head data=cmu",
    "adapt": "fit a checkpoint to one wearer: checkpoint=hmd2 recordings=DIR",
    "evaluate": "score checkpoints on a data set: checkpoint=hmd2 dataset=DIR",
    "capture": "turn recordings into motion: recording=FILE, or a DATASET",
    "live": "capture while people move: system=hmd2 source=vmc://:39540",
    "export": "export a network: checkpoint=… format=onnx|pt2|web|safetensors",
    "prepare": "make a data set: prepare simulated, prepare cmu source=DIR",
    "view": "show a recording in the browser: recording=DATASET/NAME",
    "render": "pictures without a screen: recording=DATASET/NAME out=x.png",
    "annotate": "mark hand contacts in the browser: recording=DATASET/NAME",
    "scene": "the map of a scanned scene: scene=FOLDER; objects: scene edit",
    "calibrate": "cameras: source=VIDEO columns=9 rows=6; watches: steps=watches",
    "track": "a camera's path from its video: source=VIDEO",
    "doctor": "what a recording holds, what is wrong in it, and how to fix it",
    "demo": "simulated data, training, evaluation, capture and export",
}
"""Verbs in the order of the help, each a module, with their lines."""
FIRST = {
    "adapt": "checkpoint",
    "evaluate": "checkpoint",
    "capture": "recording",
    "export": "checkpoint",
    "scene": "scene",
    "track": "source",
}
"""The setting that a word without a key is, by verbs with a config."""
COLUMNS = 80
_HYDRA = {
    *("--help", "-h", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"),
    *("--shell-completion", "-sc"),
}
"""Hydra's own options."""
_HYDRA_WITH_VALUE = {
    *("--cfg", "-c", "--info", "-i", "--package", "-p", "--config-name", "-cn", "--config-dir", "-cd"),
    *("--config-path", "-cp", "--experimental-rerun"),
}
"""Those that take a value."""
_SETTING = re.compile(r"[+~]{0,2}[A-Za-z_][\w./@-]*=")


def conf_dir() -> Path:
    """The checkout's `conf/` when the package is imported from one, else the copy that the wheel carries."""
    return resource("conf", "conf")


GIVEN = ("output", "jobs", "backend", "scheduler", "overwrite")
"""Settings of a source that all have, from `conf/prepare.yaml`."""


class Source(NamedTuple):
    """A source of `prepare`: the function of a file in `data_prep/` whose arguments are its settings."""

    file: Path
    entry: ast.FunctionDef
    about: str
    defaults: dict[str, Any]
    """Settings whose defaults are not the function's own."""


@functools.cache
def sources() -> dict[str, Source]:
    """Sources by name: files NAME.py of `data_prep/` with a function NAME_tasks or NAME_rework, and their VARIANTS."""
    found, package = dict[str, Source](), importlib.util.find_spec("data_prep")
    for folder in (package and package.submodule_search_locations) or ():
        for file in Path(folder).glob("*.py"):
            tree, name = ast.parse(file.read_text(encoding="utf-8")), file.stem
            entries = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
            assigned = (node for node in tree.body if isinstance(node, ast.Assign))
            variants = next(
                (ast.literal_eval(node.value) for node in assigned if ast.unparse(node.targets[0]) == "VARIANTS"), {}
            )
            for entry in (each for each in entries if each.name in (f"{name}_tasks", f"{name}_rework")):
                found[name] = Source(file, entry, (ast.get_docstring(tree) or "").split("\n\n")[0], {})
                found |= {key: Source(file, entry, values.pop("about"), values) for key, values in variants.items()}
    return dict(sorted(found.items()))


def overrides(verb: str, arguments: Sequence[str]) -> list[str]:
    """Arguments of a verb with a config, all as `key=value`: `--key value`, `--key=value`, `--flag`, and the verb's
    `FIRST` without a key. Hydra's own options stay."""
    given, words = [], list(arguments)
    while words:
        word = words.pop(0)
        name, equals, value = word.partition("=")
        if name in _HYDRA_WITH_VALUE:
            given += [word, *(() if equals else words[:1])]
            words = words if equals else words[1:]
        elif word.startswith("--") and name not in _HYDRA:
            if not equals:
                following = bool(words) and not _SETTING.match(words[0]) and not re.match(r"-\D", words[0])
                value = words.pop(0) if following else "true"
            given.append(f"{name[2:].replace('-', '_')}={value}")
        elif verb in FIRST and word[0] not in "-~+" and not _SETTING.match(word):
            given.append(f"{FIRST[verb]}={word}")
        else:
            given.append(word)
    return given


class Arguments(argparse.ArgumentParser):
    """A parser of `key=value` (which the help shows) and `--key value` alike; flags are key=true or key=false, lists
    key=[a,b]. What does not parse is a WearcapError."""

    def parse_args(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Parse the words that stand behind the verb."""
        positional, rest = [], []
        keys = {key.lstrip("-").replace("-", "_"): action for action in self._actions for key in _names(action)}
        for word in arguments:
            name, equals, value = word.partition("=")
            key = name.replace("-", "_")
            if not equals or not re.fullmatch(r"[A-Za-z]\w*", key) or (key not in keys and Path(word).exists()):
                rest.append(word)
            elif key not in keys:
                raise WearcapError(f"{self.prog} has no setting {name!r}", fix=nearest(key, set(keys) - {"h", "help"}))
            elif not keys[key].option_strings:
                positional.append(value)
            elif keys[key].nargs == 0:
                if value not in ("true", "false"):
                    raise WearcapError(f"{word}", expected=f"{name}=true or {name}=false")
                rest += [keys[key].option_strings[0]] * (value == "true")
            elif keys[key].nargs == "+":
                rest += [keys[key].option_strings[0], *value.removeprefix("[").removesuffix("]").split(",")]
            else:
                rest.append(f"{keys[key].option_strings[0]}={value}")
        return super().parse_args([*positional, *rest])

    def error(self, message: str) -> NoReturn:
        raise WearcapError(message, fix=f"{self.prog} --help lists the settings.")

    def format_help(self) -> str:
        """The settings as `key=value`, what the verb takes first at the top."""
        actions = sorted((each for each in self._actions if each.dest != "help"), key=lambda a: bool(a.option_strings))
        rows = []
        for action in actions:
            name = _names(action)[-1].lstrip("-").replace("-", "_")
            value = "true" if action.nargs == 0 else action.metavar or "…"
            rows.append((f"{name}={value}", (action.help or "") % {"default": action.default}))
        return page([self.description or ""], self.prog, rows) + "\n"


def _names(action: argparse.Action) -> Sequence[str]:
    return action.option_strings or [action.dest]


def page(about: Iterable[str], command: str, rows: Iterable[tuple[str, str]], after: Iterable[str] = ()) -> str:
    """A page of help: what the command does, how it is called, its settings with a text for each, and more lines."""
    lines = [*_wrapped(about), "", f"usage: {command} key=value … or --key value …", ""]
    for setting, text in rows:
        width = max(24, len(setting) + 4)
        lines += textwrap.wrap(text, COLUMNS, initial_indent=f"  {setting:{width - 2}}", subsequent_indent=" " * 24)
    return "\n".join([*lines, "", *_wrapped(after)])


def _wrapped(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in textwrap.wrap(text, COLUMNS, break_on_hyphens=False)]


def help_of(verb: str, arguments: Sequence[str]) -> str | None:
    """The page of help of a verb with a config, from the comments of its YAML: the settings up to the first empty line
    with their texts, the others by name. None: the verb has a parser of its own."""
    words = [word for word in arguments if not word.startswith("-") and "=" not in word]
    if verb == "prepare":
        return _help_of_prepare(words)
    config = "calibrate_watches" if verb == "calibrate" and "steps=watches" in arguments else verb
    file = conf_dir() / f"{config}.yaml"
    return None if words[:1] == ["edit"] or not file.is_file() else _help_of_config(f"wearcap {verb}", file)


def _help_of_prepare(words: Sequence[str]) -> str:
    if words and words[0] in sources():
        source = sources()[words[0]]
        rows, more = _signature(source) + _help_rows(conf_dir() / "prepare.yaml")[0], f"Others: see {source.file}."
        return page([source.about], f"wearcap prepare {words[0]}", rows, [more])
    rows = [(name, textwrap.shorten(each.about, COLUMNS - 24, placeholder=" …")) for name, each in sources().items()]
    return page([VERBS["prepare"]], "wearcap prepare SOURCE", rows, ["wearcap prepare SOURCE --help: its settings."])


def _signature(source: Source) -> list[tuple[str, str]]:
    """(key=value, text) of a source's settings that have a comment, behind an argument or above it."""
    lines, rows = source.file.read_text(encoding="utf-8").splitlines(), []
    arguments = source.entry.args
    for argument, default in zip(arguments.args[::-1], [*arguments.defaults[::-1], *[None] * len(arguments.args)]):
        place = argument.lineno - 1
        above = list(itertools.takewhile(lambda line: line.lstrip().startswith("# "), lines[place - 1 :: -1]))
        text = lines[place].partition("  # ")[2] or " ".join(line.strip("# ") for line in above[::-1])
        value = source.defaults.get(argument.arg)
        if value is None and isinstance(default, ast.Constant | ast.Tuple):
            value = ast.literal_eval(default)
        shown = str(list(value)).replace(" ", "") if isinstance(value, tuple) else str(value)
        shown = "…" if value is None or " " in shown else shown.lower() if isinstance(value, bool) else shown
        rows += [(f"{argument.arg}={shown}", text)] if text else []
    return rows[::-1]


def _about(text: str) -> list[str]:
    """The comments at the top of a config."""
    return re.findall(r"^# (.*)", re.split(r"^\w", text, maxsplit=1, flags=re.MULTILINE)[0], re.MULTILINE)


def _help_of_config(command: str, file: Path) -> str:
    rows, others = _help_rows(file)
    more = [f"Also {', '.join(others)}: see {file}."] if others else []
    return page(_about(file.read_text(encoding="utf-8")), command, rows, more)


def _help_rows(file: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Settings of a config up to the first empty line with their texts, and names of the others."""
    text, rows, others, shown = file.read_text(encoding="utf-8"), [], [], True
    for block in text.split("\nhydra:")[0].split("\n\n"):
        settings = _settings(block)
        rows += [(key, note) for key, note in settings if note] if shown else []
        others += [key.split("=")[0] for key, note in settings if not (shown and note)]
        shown = shown and not settings
    return rows + _groups(text), others


def _groups(text: str) -> list[tuple[str, str]]:
    """The config groups that the defaults list comments on, with their choices."""
    rows = []
    for group, choice, note in re.findall(r"^  - (\w+): (\S+) +# (.*)", text, re.MULTILINE):
        choices = ", ".join(sorted(path.stem for path in (conf_dir() / group).glob("*.yaml")))
        rows.append((f"{group}={choice.replace('null', '…')}", f"{note}: {choices}"))
    return rows


def _settings(block: str) -> list[tuple[str, str]]:
    """(key=value, its comment) of the settings at the top level of a block of YAML; comments go on in lines of their own."""
    found: list[tuple[str, str]] = []
    for line in block.splitlines():
        if (match := re.match(r"(\w+): *(.*?)(?: +# (.*))?$", line)) and match[1] != "defaults":
            plain = re.fullmatch(r"[\w.:/-]+|\[.*\]", match[2]) and match[2] != "null"
            value = match[2].replace(" ", "") if plain else "…"
            found.append((f"{match[1]}={value}", match[3] or ""))
        elif found and found[-1][1] and (more := re.match(r" {8,}# (.*)", line)):
            found[-1] = (found[-1][0], f"{found[-1][1]} {more[1]}")
    return found
