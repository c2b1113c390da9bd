"""Where a method errs: by what was done, by posture, by part of the body, and in which recordings."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping

from rich.console import Group
from rich.table import Table

from wearcap.metrics.position import PARTS
from wearcap.metrics.posture import POSTURES, PREFIX, SHARE
from wearcap.metrics.table import RATIOS, TRUTH, Row, Scores, Summary, aggregate, rich_lines

UNNAMED = "unnamed"
"""Activity of recordings that do not name any."""
PLACES = ("worst", "median", "best")


def mostly_done(activity: str) -> str:
    """What was done longest in a recording (thesis Tables 6.8–6.10), which its `activity` names first."""
    return activity.partition(",")[0].strip() or UNNAMED


def by_activity(rows: Iterable[Row], activity_of: Mapping[str, str]) -> Scores:
    """Scores by what was mostly done, of rows whose recordings' activities are given by name."""
    groups: defaultdict[str, list[Row]] = defaultdict(list)
    for row in rows:
        groups[mostly_done(activity_of[row.recording])].append(row)
    return {activity: aggregate(group) for activity, group in sorted(groups.items())}


def by_posture(rows: Iterable[Row]) -> tuple[Scores, dict[str, float]]:
    """Errors over the frames of each posture of the truth, and its share of all frames; of rows without any, nothing."""
    rows = list(rows)
    found, shares, total = {}, {}, sum(row.frames for row in rows)
    for posture in POSTURES:
        name, group = f"{PREFIX}{posture}_", []
        for row in rows:
            scores = {metric.removeprefix(name): v for metric, v in row.scores.items() if metric.startswith(name)}
            if frames := round(scores.pop(SHARE, 0.0) * row.frames):
                group.append(Row(row.recording, row.seed, frames, scores))
        if group:
            plain = posture.replace("_", " ")
            found[plain], shares[plain] = aggregate(group), sum(row.frames for row in group) / total
    return found, shares


def extremes(errors: Mapping[str, float]) -> dict[str, str]:
    """Names of the largest, median (of an even number: the lesser) and least error by `PLACES`; errors that are not
    finite are left out, and of none there is nothing."""
    ranked = sorted((name for name in errors if math.isfinite(errors[name])), key=lambda name: errors[name])
    chosen = (-1, (len(ranked) - 1) // 2, 0) if ranked else ()
    return {place: ranked[index] for place, index in zip(PLACES, chosen)}


def error_columns(scores: Mapping[str, Summary]) -> dict[str, str]:
    """Metrics of these tables, with headings: the main error, which comes first in all scores, that of each part of the
    body, and what is a share of the truth's."""
    main = next(iter(scores), "")
    parts = {f"{part}_pe_{unit}": part for unit in ("cm", "mm") for part in PARTS}
    shares = {name: name.removesuffix("_ratio") for name in RATIOS}
    columns = {main: "MPJPE" if main.startswith("mpjpe_") else main, **parts, **shares}
    return {metric: heading for metric, heading in columns.items() if metric in scores}


def part_table(title: str, scores: Scores) -> Table | Group:
    """Mean errors of methods, or of activities, by part of the body; the title gives the unit."""
    columns = error_columns(next(iter(scores.values())))
    unit = next((metric.rpartition("_")[2] for metric in columns if "_pe_" in metric), "")
    means = {
        name: {metric: Summary(each[metric].mean, None, 1) for metric in columns if metric in each}
        for name, each in scores.items()
    }
    shares = [name for name in columns if name in RATIOS]
    for name in [
        name for name in shares if any(math.isnan(each[name].mean) for each in means.values() if name in each)
    ]:
        metric = RATIOS[name]  # of a truth that is almost 0: the difference
        columns[name] += " beyond the truth's"
        shares.remove(name)
        for method, each in scores.items():
            if {metric, f"{TRUTH}{metric}"} <= set(each):
                means[method][name] = Summary(each[metric].mean - each[f"{TRUTH}{metric}"].mean, None, 1)
    of_truth = [f"{' and '.join(columns[name] for name in shares)} of the truth's"] if shares else []
    about = "; ".join([*([unit] if unit else []), *of_truth])
    return rich_lines(f"{title} ({about})" if about else title, means, columns)


def activity_table(title: str, activities: Scores, counts: Mapping[str, int]) -> Table | Group:
    """Errors of one method by activity, the worst first; `counts` of their recordings are shown beside the names."""
    main = next(iter(next(iter(activities.values()))))
    ranked = sorted(activities, key=lambda name: -activities[name][main].mean)
    return part_table(title, {f"{name} ({counts[name]})": activities[name] for name in ranked})


def posture_table(title: str, errors: Scores, shares: Mapping[str, float]) -> Table | Group:
    """Errors of one method by posture, the worst first, with the share of the frames that it has."""
    main = next(iter(next(iter(errors.values()))))
    ranked = sorted(errors, key=lambda name: -errors[name][main].mean)
    return part_table(title, {f"{name} ({100 * shares[name]:.0f} %)": errors[name] for name in ranked})


def recording_table(title: str, rows: Iterable[Row], activity_of: Mapping[str, str]) -> Table | Group:
    """The recordings of largest, median and least error of one method, by name."""
    rows = list(rows)
    shown = {
        f"{place}: {name}, {mostly_done(activity_of[name])}": aggregate([row for row in rows if row.recording == name])
        for place, name in extremes(main_errors(rows)).items()
    }
    return part_table(title, shown)


def main_errors(rows: Iterable[Row]) -> dict[str, float]:
    """The main error of each recording, the mean over its seeds."""
    found: defaultdict[str, list[float]] = defaultdict(list)
    for row in rows:
        found[row.recording].append(next(iter(row.scores.values())))
    return {name: sum(values) / len(values) for name, values in found.items()}
