"""`data_prep/` stays in step with `wearcap prepare`: a file or another source's, a row of its page, a split list where one is read."""

import re
from pathlib import Path

import pytest

from wearcap.cli.conf import compose, splits_dir
from wearcap.cli.verbs import help_of, sources
from wearcap.prepare import Splits

DATA_PREP = Path(__file__).parents[1] / "data_prep"
PAGE = (DATA_PREP / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("source", sources())
def test_the_page_tells_what_a_source_needs(source):
    assert f"\n  {source} " in help_of("prepare", [])
    row = next((line for line in PAGE.splitlines() if line.startswith(f"| `{source}` |")), "")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert len(cells) == 6, f"no complete row for {source} in data_prep/README.md"
    assert all(cells)
    command = cells[4].split("`")[1].split()
    assert command[:3] == ["wearcap", "prepare", source]
    compose("prepare", [f"prepare={source}", *command[3:]])
    config = sources()[source].read_text(encoding="utf-8")
    if "rework:" not in config:  # these keep the splits of the data set that they change
        listed = re.search(r"^splits: (\S+)", config, re.MULTILINE)
        name = listed[1] if listed else f"{source}.csv"
        assert f"`{name}`" in cells[5]
        assert Splits.read(splits_dir() / name).rows


def test_every_file_serves_a_source_and_every_list_has_one():
    configs = {name: path.read_text(encoding="utf-8") for name, path in sources().items()}
    used = {file for text in configs.values() for file in re.findall(r"_target_: data_prep\.(\w+)\.", text)}
    by_others = {"__init__", "adt", "nymeria_alignment", "one_object", "ui_prmd"}
    files = {path.stem for path in DATA_PREP.glob("*.py")} - by_others
    assert files <= used
    assert all(f"data_prep.{name}." in configs[name] for name in files & configs.keys())
    assert {path.stem for path in (DATA_PREP / "splits").glob("*.csv")} <= configs.keys()
