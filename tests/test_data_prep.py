"""`data_prep/` stays in step with its page: a row for each source, a split list where one is read, a text for each setting."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from data_prep.shared.engine import Splits
from wearcap.cli.conf import compose, splits_dir
from wearcap.cli.verbs import help_of, sources

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
    config = compose("prepare", [f"prepare={source}", *command[3:]])
    if "tasks" in config:  # a rework keeps the splits of the data set that it changes
        assert f"`{config.splits}`" in cells[5]
        assert Splits.read(splits_dir() / config.splits).rows


def test_every_list_has_a_source_and_every_setting_a_default_or_a_text():
    assert {path.stem for path in (DATA_PREP / "splits").glob("*.csv")} <= sources().keys()
    for source in sources():
        config = compose("prepare", [f"prepare={source}"])
        missing = {str(key) for key in config if OmegaConf.is_missing(config, key)}
        shown = {row.strip().split("=")[0] for row in help_of("prepare", [source]).splitlines() if "=" in row}
        assert missing - {"right"} <= shown, source
