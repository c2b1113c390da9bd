"""Sentences on ECHO's limits for its page of results, from its published tables."""

import re

from echo_paper import PAPER
from result_pages import Tree, Trees, mean, rows_of, upside_down

EQUAL = "Table 1, equal budgets"
"""Title of the table of rivals."""
OURS_SAW = 37.4
"""Million frames that the shared checkpoint saw in its four trainings; its own record is of the last."""
OURS, RIVAL, ALONE = "ours, the same budget", "BoDiffusion-style + object, its mean", "BoDiffusion-style, its mean"
"""Rows of equal budgets: ours, and the rival with an object and without."""


def limits(trees: Trees, with_objects: str, cmu: str, hdm05: str) -> tuple[str, ...]:
    """All of them; the titles are of the tables of objects and of the two of people alone."""
    objects, people, strangers = (rows_of(trees, title) for title in (with_objects, cmu, hdm05))
    rivals = rows_of(trees, EQUAL)
    paper = PAPER["paper: BEHAVE"]
    return (
        *_rivals(rivals, people, strangers),
        _orientation(objects),
        _hinges(objects),
        _guidance(rows_of(trees, "Ablation"), rows_of(trees, "Settings")),
        *_observing(rows_of(trees, "Tables 3, S2")),
        *_recordings_of_objects(trees),
        *upside_down(people, "mpjpe_mm", "mm", 1),
        _budgets(rivals),
        f"The paper reports {paper['mpjpe_mm'].mean:.1f} mm, E_v2v {paper['v2v_cm'].mean:.1f} cm and E_c {paper['center_cm'].mean:.1f} cm on "
        "BEHAVE, real recordings: no comparison.",
        "No recording of real people with objects has been captured.",
    )


def _rivals(objects: dict[str, Tree], *people: dict[str, Tree]) -> tuple[str, str]:
    """Where rivals of equal budget are better, and where ours is."""

    def pair(metric: str, digits: int = 1) -> str:
        return " against ".join(mean(objects[row][metric], digits) for row in (OURS, RIVAL))

    bodies = [" against ".join(mean(rows[row]["mpjpe_mm"]) for row in (ALONE, OURS)) for rows in (*people, objects)]
    return (
        f"By the paper's own metric the rival with an object wins at equal budget: E_v2v is {pair('v2v_cm')} cm, the rotation's error "
        f"{pair('rotation_deg', 0)}° (ours against the rival's). Modulo the object's symmetry ours wins: {pair('symmetric_v2v_cm')} cm, "
        f"{pair('symmetric_rotation_deg', 0)}°, as it does in the centre, {pair('center_cm')} cm. Ours learns orientations modulo "
        "symmetry, the rival as they are.",
        f"On people without objects the BoDiffusion-style rival is better: {bodies[0]} mm of ours of equal budget on CMU, {bodies[1]} on "
        f"HDM05, {bodies[2]} on simulated people with objects, which it does not capture. Its feet slide more.",
    )


def _orientation(objects: dict[str, Tree]) -> str:
    """How far objects are turned, by what is known of them."""
    rows = ("ours", "ours, hinges and rails unknown", "nearest training window")
    off = [
        f"{mean(objects[row]['rotation_deg'], 0)}° ({mean(objects[row]['symmetric_rotation_deg'], 0)}° modulo symmetry)"
        for row in rows
    ]
    return (
        f"Head and wrists tell little of an object's orientation: it is {off[0]} off, with unknown hinges and rails {off[1]}, that of the "
        f"nearest training window {off[2]}."
    )


def _hinges(objects: dict[str, Tree]) -> str:
    """What the environment's hinges and rails are worth."""
    rows = "ours, environment exact", "ours", "ours, hinges and rails unknown"
    errors = [mean(objects[row]["fastened_center_cm"]) for row in rows]
    return (
        "Hinges and rails are those of the environment as people measure them (objects 2 cm and 2° off, hinges 1.5 cm). Centres of doors, "
        f"drawers and windows are {errors[0]} cm off with exact, {errors[1]} with measured and {errors[2]} with unknown ones."
    )


def _guidance(ablation: dict[str, Tree], settings: dict[str, Tree]) -> str:
    """What guidance by contacts is worth by itself, with unknown hinges."""
    rows = (
        (ablation, "ours without guidance, as long as the others", "the same, guided by contacts"),
        (settings, "not guided by contacts", "hinges and rails unknown"),
    )
    brief, usual = (" to ".join(mean(of[row]["center_cm"]) for row in pair) for of, *pair in rows)
    return (
        f"Guidance by contacts alone brings nothing: E_c goes from {brief} cm in a brief training, from {usual} cm with the checkpoint on "
        "validation. Rows “guided, hinges and rails known” of Table S2 gain by the hinges."
    )


def _observing(rows: dict[str, Tree]) -> tuple[str, ...]:
    """What observed contacts, and a part of the body, do to the rest."""
    none, contacts, body = (rows[name] for name in ("nothing", "100 % of contact", "25 % of human"))
    off, jitter = (
        f"{mean(one[m])} against {mean(none[m])}" for one, m in ((contacts, "center_cm"), (body, "jitter_m_s3"))
    )
    return (
        f"Observed contacts do not help the object, unlike in the paper, where they help it most: E_c {off} cm without any.",
        f"Bodies jitter between observed and generated frames: {jitter} m/s³ with a quarter of the body's observed.",
    )


def _recordings_of_objects(trees: Trees) -> tuple[str, ...]:
    """How much of the test split the rows of objects are of."""
    counts = {
        title.split(":")[0]: found[1]
        for tree in trees.values()
        for title, about in tree.get("origins", {}).items()
        if title.startswith("Table 1") and (found := re.search(r"--recordings (\d+)", about["command"]))
    }
    rivals = f" (those at equal budgets of {counts[EQUAL]})" if EQUAL in counts and len(counts) > 1 else ""
    return tuple(
        f"Rows of objects are of {whole} recordings of two minutes of the test split{rivals}, on whose few objects they depend."
        for title, whole in counts.items()
        if title == "Table 1"
    )


def _budgets(rivals: dict[str, Tree]) -> str:
    """How the learned baselines were trained."""
    return (
        f"The rivals saw {mean(rivals[RIVAL]['frames_seen_m'])} million frames in one training, at the better of two rates, "
        f"ours beside them {mean(rivals[OURS]['frames_seen_m'])} in each of {mean(rivals[OURS]['trainings'], 0)}, whose mean its rows are; our "
        f"checkpoint {OURS_SAW} in four trainings."
    )
