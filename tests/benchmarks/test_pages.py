"""Pages of results: rendered from JSON alone, published JSON is merged, README says what the JSON says."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from benchmarks.tables import command
from benchmarks.tables import hps as tables_hps
from benchmarks.tables.command import page_of
from benchmarks.tables.hps_runs import DISTURBED, ROWS, TRUTH
from benchmarks.tables.result_pages import (
    Grid,
    Page,
    commands,
    compact,
    everything,
    number,
    origin,
    picked,
    publish,
    ranged,
    read_speed,
    render,
    results,
    score_grids,
    text,
    with_readme,
    write_speed,
)
from wearcap.errors import WearcapError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = sorted(path.stem for path in RESULTS.glob("*.md"))


def summary(mean: float | None, std: float | None = None, seeds: int = 1) -> dict:
    return {"mean": mean, "std": std, "seeds": seeds}


ABOUT = {"command": "python benchmarks/tables.py echo", "date": "2026-11-01", "machine": "a machine"}


def small_page(rows: int = 2, **changes):
    headline = Grid("What was measured.", ("", "error (cm)"), [[f"row {k}", f"{k}.00"] for k in range(rows)])
    grid = Grid("Table 9: all of it", ("", "error"), [["ours", "1.25 ± 0.10"]], "`command`, today, here.")
    parts = {
        "title": "A system",
        "headline": headline,
        "held_out": "People.",
        "simulated": "Sensors.",
        "limits": ("One.", "Two."),
        "full": [grid],
        "commands": ("python benchmarks/tables.py echo",),
        "measured": "joints 1.2 cm off",
    }
    return Page(**{**parts, **changes})


FAST = {"fast_fps": "Everything, poses given", "slow_fps": "Nothing"}


def fast(value: float, machine: str) -> dict:
    about = {**ABOUT, "machine": f"{machine}, 2 cores, Linux"}
    figure = {"name": "fast_fps", "unit": "frames/s, all (of them)", "baseline": 30.0, "goal": None}
    return {**figure, "value": value, "ratio": value / 30.0, "benchmark": "fast_fps", **about}


def test_a_page_has_its_sections_in_order():
    page = small_page(clocks=FAST, pictures=(("echo_box.png", "A box, carried"),))
    shown = render("echo", page, {"fast_fps": [fast(90.4, "AMD EPYC"), fast(120.0, "Intel(R) Xeon(R) Processor")]})
    headings = re.findall(r"^#+ .*", shown, re.MULTILINE)
    names = ("Held out", "Simulated", "Limits", "Speed", "Pictures", "Commands")
    assert headings == ["# A system", *(f"## {name}" for name in names)]
    assert "| row 1 | 1.00 |" in shown.split("## Held out")[0]
    assert "- One.\n- Two." in shown
    assert "- Everything, poses given: 90.4 to 120 frames/s, 3.01 to 4.00 × (AMD EPYC, Intel Xeon)." in shown
    assert "Nothing" not in shown
    assert "Table 9" not in shown
    assert "```\npython benchmarks/tables.py echo\npython benchmarks/run.py fast_fps slow_fps --write" in shown


def test_all_tables_are_printed_and_every_figure_of_speed():
    figures = {"fast_fps": [fast(90.4, "AMD EPYC")], "echo_old": [{**fast(1.0, "AMD EPYC"), "name": "echo_old"}]}
    shown = everything("echo", small_page(clocks=FAST), figures)
    assert (
        "## Table 9: all of it\n\n`command`, today, here.\n\n|  | error |\n| --- | ---: |\n| ours | 1.25 ± 0.10 |"
        in shown
    )
    assert (
        "| `fast_fps` | Everything, poses given | 90.4 | 30.0 | 3.01 | frames/s, all (of them) | 2026-11-01 |" in shown
    )
    assert "| `echo_old` |  | 1.00 |" in shown
    assert "| row 1 | 1.00 |" in shown


@pytest.mark.parametrize(
    ("page", "found"),
    [({"rows": 11}, "11 rows"), ({"columns": 9}, "9 columns"), ({"held_out": "word " * 1200}, r"12\d\d words")],
)
def test_a_page_that_nobody_reads_is_refused(page, found):
    assert "row 9" in render("echo", small_page(10), {})
    columns = page.pop("columns", 2)
    page = small_page(page.pop("rows", 1), **page)
    wide = Grid("Wide.", ("",) * columns, [["1"] * columns]) if columns > 2 else page.headline
    with pytest.raises(WearcapError, match=found):
        render("echo", dataclasses.replace(page, headline=wide), {})


def test_tables_of_before_the_repair_say_so():
    table = {"ours": {"a_cm": summary(1.256, 0.04, 4)}, "paper: theirs": {"b_cm": summary(2.0)}}
    tree = {"about": ABOUT, "tables": {"Table 1": table}}
    (grid,) = score_grids(tree, {"b_cm": ("B", 1), "a_cm": ("A", 2)})
    assert grid.columns == ("", "B", "A")
    assert grid.rows == [["ours", "–", "1.26 ± 0.04"], ["paper: theirs", "2.0", "–"]]
    assert grid.origin.endswith("a machine, 4 seeds, bent knees.")
    assert "bent knees" not in origin({**ABOUT, "date": "2026-11-28"})
    line = "are of bent knees"
    assert line in render("echo", small_page(full=[grid]), {})
    assert line not in render("echo", small_page(), {})
    assert "(../../checkpoints/echo.md)" in render("echo", small_page(full=[grid]), {})
    assert "checkpoints" not in render("hps", small_page(full=[grid]), {})


def test_commands_leave_out_what_chooses_rows_and_tables_that_later_runs_leave():
    def by(command: str, date: str) -> dict:
        return {**ABOUT, "command": f"python benchmarks/tables.py echo {command}", "date": date}

    origins = {
        "before it, Table 2: CMU": by("--parts human --keep 'before it'", "2026-11-01"),
        "Table 2: CMU": by("--parts human --rows none --leave 'our own' --seeds 1", "2026-11-03"),
        "Table 1: objects": by("--parts human --seeds 1", "2026-11-02"),
    }
    tree = {"about": ABOUT, "tables": {title: {} for title in origins}, "origins": origins}
    assert commands({"echo": tree}) == (
        "python benchmarks/tables.py echo --parts human --seeds 1  # 2026-11-03, a machine",
    )
    assert commands({"hps": {"about": ABOUT}}) == ("python benchmarks/tables.py echo  # 2026-11-01, a machine",)


def test_cells_of_what_is_not_known_and_ranges():
    assert text(None) == text(summary(None)) == "–"
    assert [text(summary(1.25, std)) for std in (None, 0.004, 0.006)] == ["1.25", "1.25", "1.25 ± 0.01"]
    assert ranged([summary(3.21), summary(2.44), summary(None), summary(4.96)]) == "2.4 to 5.0"
    assert ranged([summary(3.21)]) == "3.2"
    assert ranged([]) == ""
    assert [number(value) for value in (0.59, 4976.4, 0.0, 12.34, None)] == ["0.590", "4976", "0", "12.3", "–"]


def test_what_is_kept_stays_and_is_shown_beside_what_is_new(tmp_path):
    def scores(error: float) -> dict:
        return {"ours": {"a_cm": summary(error)}, "ours, 3 cm too tall": {"a_cm": summary(9.0)}, "truth": {}}

    folder, made = tmp_path / "results", tmp_path / "echo.json"
    folder.mkdir()
    for title, error in (("before it, Table 2: CMU", 8.0), ("Table 2: CMU", 6.0), ("Table 2: CMU, longer", 5.0)):
        made.write_text(json.dumps({"about": ABOUT, "tables": {title: scores(error)}}))
        tree = json.loads(publish(made, folder).read_text())
    assert list(tree["tables"]) == ["before it, Table 2: CMU", "Table 2: CMU, longer"]
    grid = next(grid for grid in score_grids(tree, {}) if grid.title == "Table 2: CMU, longer")
    named = {row[0]: row[1] for row in grid.rows}
    assert (named["ours"], named["before it: ours"], named["before it: ours, 3 cm too tall"]) == (
        "5.00",
        "8.00",
        "9.00",
    )
    lines = picked({"echo": tree}, [("Table 2", "ours", "CMU"), ("Table 9", "ours", "none")], [("error", "a_cm", 1)])
    assert lines == [["CMU", "5.0"]]


def test_published_tables_are_merged_by_number(tmp_path):
    folder, made = tmp_path / "results", tmp_path / "echo.json"
    folder.mkdir()
    for date, tables in (("d1", {"A: old": {"x": 1}, "B: old": {"x": 2}}), ("d2", {"B: new": {"x": 3}})):
        made.write_text(
            json.dumps({"about": {**ABOUT, "date": date}, "tables": tables, "seeds": [{"frames": [0] * 99}]})
        )
        path = publish(made, folder)
    found = json.loads(path.read_text())
    assert found["tables"] == {"A: old": {"x": 1}, "B: new": {"x": 3}}
    assert {title: about["date"] for title, about in found["origins"].items()} == {"A: old": "d1", "B: new": "d2"}
    assert "seeds" not in found
    made.write_text(json.dumps({"about": ABOUT, "rows": {"ours": 1}}))
    assert set(json.loads(publish(made, folder).read_text())) == {"about", "rows"}


@pytest.mark.parametrize("as_list", [False, True])
def test_rows_that_a_run_leaves_stay_and_name_their_own_command(tmp_path, as_list):
    def made(date: str, rows: dict) -> dict:
        table = [{"method": name, "x": value} for name, value in rows.items()] if as_list else rows
        about = {**ABOUT, "date": date, "command": f"run {date}"}
        return {"about": about, "tables": {f"A: {date}": table}, "percentiles": rows, "scenarios": {"B": rows}}

    folder, path = tmp_path / "results", tmp_path / "hmd2.json"
    folder.mkdir()
    runs = (("d1", {"rival": 1, "gone": 2, "ours": 3}), ("d2", {"ours": 4}), ("d3", {"ours": 5}))
    for date, rows in runs:
        path.write_text(json.dumps(made(date, rows)))
        found = json.loads(publish(path, folder, ["rival", "absent"]).read_text())
    (title, table), expected = next(iter(found["tables"].items())), {"rival": 1, "ours": 5}
    assert title == "A: d3"
    assert ({row["method"]: row["x"] for row in table} if as_list else table) == expected
    assert found["percentiles"] == found["scenarios"]["B"] == expected
    words = origin(found["origins"][title])
    assert words.startswith("`run d3`, d3")
    assert "Of an earlier run: rival (`run d1`, d1" in words
    assert "abouts" not in found


def test_published_json_is_short():
    shown = compact({"about": ABOUT, "rows": {"ours": [summary(1.23456789, None, 4), {"a": summary(2.0)}]}})
    assert json.loads(shown)["rows"]["ours"] == [summary(1.23457, None, 4), {"a": summary(2.0)}]
    assert '{"mean":1.23457,"std":null,"seeds":4}' in shown


def test_figures_of_speed_replace_those_of_their_benchmark_alone(tmp_path):
    path = tmp_path / "speed.jsonl"
    write_speed(path, "b", [{"name": "b", "value": 1.0}, {"name": "b_small", "value": 2.0}], ABOUT)
    write_speed(path, "a", [{"name": "a", "value": 3.0}], ABOUT)
    write_speed(path, "b", [{"name": "b", "value": 4.0}], ABOUT)
    assert {name: [f["value"] for f in figures] for name, figures in read_speed(path).items()} == {
        "a": [3.0],
        "b": [4.0],
    }
    assert read_speed(path)["a"][0]["date"] == ABOUT["date"]
    write_speed(path, "a", [{"name": "a", "value": 5.0}], {**ABOUT, "machine": "another"})
    assert [figure["value"] for figure in read_speed(path)["a"]] == [5.0, 3.0], "machines stand side by side"
    assert read_speed(tmp_path / "none.jsonl") == {}


def test_a_systems_results_are_not_those_of_one_with_a_longer_name(tmp_path):
    for name in ("hmd2", "hmd2_cmu", "hmd2_head", "hps"):
        (tmp_path / f"{name}.json").write_text("{}")
    assert list(results("hmd2", ["hmd2", "hmd2_head", "hps"], tmp_path)) == ["hmd2", "hmd2_cmu"]


def test_readme_takes_a_pages_cells_and_keeps_all_else():
    readme = "| [ECHO](docs/echo.md) | head | body | 9 cm | 3 × |\n| [HPS](docs/hps.md) | suit | body | 1 cm | 2 × |\n"
    assert with_readme(readme, "echo", small_page()) == readme.replace("9 cm", "joints 1.2 cm off")
    assert "| 5 × |" in with_readme(readme, "hps", small_page(speed="5 ×"))
    with pytest.raises(WearcapError, match="no row"):
        with_readme(readme, "hmd2", small_page())


@pytest.mark.parametrize("system", PAGES)
def test_the_page_is_what_its_json_gives(system):
    """Neither a page nor README's row holds a figure that the JSON beside the page does not."""
    page = page_of(system)
    assert all((ROOT / "docs" / name).is_file() for name, _ in page.pictures)
    assert render(system, page, read_speed()) == (RESULTS / f"{system}.md").read_text(encoding="utf-8")
    if page.measured or page.speed:
        readme = (ROOT / "README.md").read_text(encoding="utf-8")
        assert with_readme(readme, system, page) == readme


@pytest.mark.parametrize("system", PAGES)
def test_a_page_is_one_table_and_what_a_person_reads(system):
    page = (RESULTS / f"{system}.md").read_text(encoding="utf-8")
    assert len(page.split()) <= 1200
    (table,) = re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)
    lines = table.splitlines()
    assert len(lines) - 2 <= 10
    assert max(line.count(" |") for line in lines) <= 8


@pytest.mark.parametrize("system", PAGES)
def test_all_prints_every_table_of_the_json(system, capsys):
    command.main([system, "--all"])
    shown = capsys.readouterr().out
    trees = command.pages.results(system, command.SYSTEMS)
    assert trees
    for tree in trees.values():
        for title, rows in tree.get("tables", {}).items():
            named = (
                [row["method"] for row in rows] if isinstance(rows, list) else rows if system != "simulation" else ()
            )
            assert not named or title in shown
            assert all(f"| {name} |" in shown for name in named)
        assert all(f"| {name} |" in shown for name in tree.get("rows", tree.get("whole", ())))


@pytest.mark.parametrize("path", [*RESULTS.parent.rglob("*.md")], ids=lambda path: path.stem)
def test_a_page_begins_with_what_one_can_do_after_it(path):
    title, first, *_ = path.read_text(encoding="utf-8").split("\n\n")
    assert title.startswith("# ")
    assert first.startswith("After this page ")


def test_every_system_has_a_page():
    assert {"hps", "ireplica", "hmd2", "mocap_every", "echo", "simulation"} <= set(PAGES)
    assert max(path.stat().st_size for path in RESULTS.iterdir()) < 200_000


def test_all_of_the_documentation_is_read_in_an_evening():
    readme = len((ROOT / "README.md").read_text(encoding="utf-8").split())
    pages = sum(len(path.read_text(encoding="utf-8").split()) for path in (ROOT / "docs").rglob("*.md"))
    assert readme <= 700
    assert readme + pages <= 30_000


def hps_run(ours_cm: float) -> dict:
    """What `hps_runs.run_seed` measures of one session, as far as its page shows it."""

    def scores(cm: float) -> dict:
        chamfer = [{"mean_cm": cm, "cloud_to_body_cm": cm}] * 8
        feet = {"distance_cm": cm, "absolute_distance_cm": cm, "sliding_cm": cm}
        joints = ("mpjpe_cm", "root_cm", "p95_cm", "jitter_m_s3", "jitter_ratio", "foot_skate_cm_s")
        return {
            "literal": chamfer, "surface": chamfer, "feet": feet, "feet_true_contact": feet,
            "joints": dict.fromkeys(joints, cm), "drift": {"slope_cm_per_100m": cm},
        }  # fmt: skip

    lost = dict.fromkeys(("root_cm", "root_ratio", "joint_cm", "joint_ratio"), 9.9)
    return {
        "visits": [{"name": name, "distance_m": m} for m in (0.0, 70.0, 200.0, 380.0) for name in ("stand", "move")],
        "scores": {row: scores(ours_cm if row == "ours" else 50.0) for row in (*ROWS, TRUTH)},
        "outages": {"rows": {row: {"within 30 s": lost, "whole recording": lost} for row in DISTURBED}},
        "stage_seconds": {row: {"optimise": 4.0} for row in ROWS},
        "frames": 12000,
    }


def test_hps_page_shows_the_range_over_presets_of_sensors():
    def tree(sensors: str, *ours_cm: float) -> dict:
        found = tables_hps.summarized([hps_run(cm) for cm in ours_cm])
        return {"about": ABOUT, "sensors": sensors, "places": ["at start", "70 m", "200 m", "380 m"], **found}

    one = tables_hps.page({"hps": tree("typical", 3.0, 4.0)}, {})
    assert (
        one.measured
        == "joints 3.5 cm off over 380 m and more, with typical sensors (the authors' code 50.0; suit alone: 50)"
    )
    assert one.speed == "100 × real time, localised cameras given (a machine)"
    trees = {"hps": tree("typical", 3.0, 4.0), "hps_ideal": tree("ideal", 2.0), "hps_poor": tree("poor", 7.0)}
    page = tables_hps.page(trees, {})
    assert page.measured.startswith("joints 2.0 to 7.0 cm off")
    shown = render("hps", page, {})
    assert [line.split(" | ")[1] for line in shown.splitlines() if line.startswith("| **ours**")] == [
        "2.0",
        "3.5 ± 0.7",
        "7.0",
    ]
    assert "the truth itself is 50.0 and 50.0 cm from them" in shown
    assert sum("Table 4.1" in grid.title for grid in page.full) == 3
    assert "When localisation is lost in mid-walk for 30 s the root is 9.9 cm off meanwhile" in shown
