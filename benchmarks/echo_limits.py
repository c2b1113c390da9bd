"""Sentences on ECHO's limits for its page of results, from its published tables."""

import re

from result_pages import Tree, Trees, mean

EQUAL = "Table 1, equal budgets"
"""Title of the table of rivals."""
OURS_SAW = 37.4
"""Million frames that the shared checkpoint saw in its four trainings; its own record is of the last."""


def orientation(objects: dict[str, Tree]) -> str:
    """How far objects are turned, by what is known of them."""
    rows = {
        "ours": "An object's orientation is off by",
        "ours, hinges and rails unknown": "with unknown hinges and rails by",
        "nearest training window": "that of the nearest training window by",
    }
    phrases = [
        f"{what} {mean(objects[row]['rotation_deg'], 0)}° ({mean(objects[row].get('symmetric_rotation_deg'), 0)}° modulo its symmetry)"
        for row, what in rows.items()
        if row in objects
    ]
    return (
        ", ".join(phrases)
        + ": head and wrists alone tell little of it, and large objects' vertices go with it. With hinges and rails most of it is known."
    )


def observing(rows: dict[str, Tree]) -> tuple[str, ...]:
    """What observed contacts, and a part of the body, do to the rest."""
    none, contacts, body = (rows.get(name) for name in ("nothing", "100 % of contact", "25 % of human"))
    if none is None or contacts is None or body is None:
        return ()
    off, jitter = (
        f"{mean(one[m])} against {mean(none[m])}" for one, m in ((contacts, "center_cm"), (body, "jitter_m_s3"))
    )
    return (
        f"Observed contacts do not help the object, unlike in the paper, where they help it most: E_c {off} cm without any.",
        f"Body motion jitters between observed and generated frames: {jitter} m/s³ with a quarter of the body's.",
    )


def recordings_of_objects(trees: Trees) -> tuple[str, ...]:
    """How much of the test split the rows of objects are of."""
    counts = {
        title.split(":")[0]: found[1]
        for tree in trees.values()
        for title, about in tree.get("origins", {}).items()
        if title.startswith("Table 1") and (found := re.search(r"--recordings (\d+)", about["command"]))
    }
    if not counts:
        return ()
    rivals = f" (those at equal budgets of {counts[EQUAL]})" if EQUAL in counts and len(counts) > 1 else ""
    return (
        f"Rows of objects are of {counts.get('Table 1', counts.get(EQUAL))} recordings of two minutes of the test split{rivals}, "
        "on whose few objects they depend.",
    )


def hinges(objects: dict[str, Tree]) -> tuple[str, ...]:
    """What the environment's hinges and rails are worth."""
    rows = "ours, environment exact", "ours", "ours, hinges and rails unknown"
    errors = [mean(objects[row]["fastened_center_cm"]) for row in rows if "fastened_center_cm" in objects.get(row, {})]
    if len(errors) < len(rows):
        return ()
    return (
        "Hinges and rails are those of the environment, as people measure them: objects 2 cm and 2° off, hinges 1.5 cm. "
        "Without them it is guessed where a door is and to which side it opens, until it turns. Centres of doors, drawers and "
        f"windows are {errors[0]} cm off with exact hinges, {errors[1]} with measured and {errors[2]} with unknown ones.",
    )


def conveyor(speed: dict[str, list[Tree]]) -> tuple[str, ...]:
    """What the conveyor gains over windows with as many evaluations."""
    figures = {figure["name"]: figure for figure in speed.get("echo_conveyor_vs_rewindow", [])}
    marks = "jitter_m_s3", "mpjpe_mm", "v2v_cm"
    names = "echo_conveyor_vs_equal_windows", *(f"echo_conveyor_equal_{mark}" for mark in marks)
    if not set(names) <= set(figures):
        return ()
    time, jitter, error, placed = (
        f"{figures[name]['value']:.1f} against {figures[name]['baseline']:.1f}" for name in names
    )
    faster = "no faster" if figures[names[0]]["ratio"] < 1.1 else "faster"
    calmer = "smoother" if figures[names[1]]["ratio"] < 0.9 else "no smoother"
    return (
        f"The conveyor is {faster} than windows with as many evaluations of the network ({time} ms a frame), and {calmer}: "
        f"jitter {jitter} m/s³, MPJPE {error} mm, E_v2v {placed} cm, of one seed.",
    )


def budgets(objects: dict[str, Tree], people: dict[str, Tree], strangers: dict[str, Tree]) -> tuple[str, ...]:
    """How the learned baselines were trained, and what that tells: with objects, on CMU's people, on another laboratory's."""
    ours, theirs = "ours, the same budget", "BoDiffusion-style + object, its mean"
    if ours not in objects or theirs not in objects:
        return ()
    parts = [
        f"{mean(objects[theirs][key], n)} against {mean(objects[ours][key], n)} {unit}"
        for key, unit, n in (
            ("mpjpe_mm", "mm", 1),
            ("jitter_m_s3", "m/s³ of jitter", 0),
            ("center_cm", "cm of the object's centre", 1),
            ("symmetric_v2v_cm", "cm of its vertices modulo symmetry", 1),
        )
    ]
    alone = [
        f"{', '.join(mean(rows[row]['mpjpe_mm']) for row in (theirs, ours, 'ours'))} mm on {who}"
        for who, rows in (("CMU's", people), ("HDM05's", strangers))
        if {theirs, ours, "ours"} <= set(rows)
    ]
    bodies = "BoDiffusion-style, its mean"
    bare = [mean(rows[bodies]["mpjpe_mm"]) for rows in (objects, people, strangers) if bodies in rows]
    without = (
        f" The rival without an object, trained alike: {', '.join(bare)} mm of the same three."
        if len(bare) == 3
        else ""
    )
    count = objects[ours].get("trainings")
    several = f"ours in {mean(count, 0)} of other seeds, whose mean its rows are" if count else "ours in one"
    return (
        "BoDiffusion-style + object has ECHO's network, inputs and losses (a quarter of our weight on skating, none on held "
        "objects, whose orientations it learns as they are, not modulo symmetry), one noise level for a whole "
        f"window, and no contacts. It saw {mean(objects[theirs]['frames_seen_m'], 1)} million frames, as did ours beside it, "
        "of the data that our checkpoint learned from last, from drawn weights at a learning rate of 0.003: the rival in one "
        f"training, at the better of two rates, {several}. Captured alike, with objects: {', '.join(parts)}. People alone, the "
        f"rival, ours beside it, and our checkpoint, which saw {OURS_SAW} million in four trainings: {'; '.join(alone)}.{without} "
        "Other baselines saw what their rows say.",
        "Diffusions are captured twice: as samples, ours on the conveyor, and, named so, as the mean of averaged windows in one "
        "step, mirrored, too, with arms that reach the wrists, as ours, but with feet that are not held: they learn no contacts.",
    )
