"""Sentences on ECHO's limits for its page of results, from its published tables."""

import re

from result_pages import Tree, Trees, mean

EQUAL = "Table 1, equal budgets"
"""Title of the table of rivals."""


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


def budgets(objects: dict[str, Tree], people: dict[str, Tree]) -> tuple[str, ...]:
    """How the learned baselines were trained, and what that tells."""
    ours = "ours, the same budget"
    if ours not in objects:
        return ()
    seen = mean(objects[ours]["frames_seen_m"], 2)
    phrases = [
        f"{row} {mean(rows[row]['mpjpe_mm'])} mm off ({what}; ours so trained {mean(rows[ours]['mpjpe_mm'])})"
        for what, rows in (("objects", objects), ("people alone", people))
        for row in ("BoDiffusion-style + object, its mean", "BoDiffusion-style, its mean", "AGRoL-style, its mean")
        if row in rows and ours in rows
    ]
    theirs, mine = objects.get("BoDiffusion-style + object, its mean", {}), objects[ours]
    parts = (("jitter_m_s3", "m/s³ of jitter", 0), ("center_cm", "cm of the object's centre", 1))
    rest = [f"{mean(mine[key], n)} against {mean(theirs[key], n)} {unit}" for key, unit, n in parts if key in theirs]
    return (
        f"Learned baselines, and ours beside them, saw {seen} million frames each, in one training, of a part of the "
        f"simulated motion and of CMU's; the losses of all were still falling: {'; '.join(phrases)}. Against BoDiffusion-"
        f"style + object, which has one noise level for a whole window, ours so trained and captured has {', '.join(rest)}.",
        "Diffusions are captured twice: as samples, ours on the conveyor, and, named so, as the mean of averaged windows in one "
        "step, with arms that reach the wrists, as ours, but with feet that are not held: they learn no contacts. The learning "
        "rate of these, and of ours beside them, is the one that was best in a sweep before, 0.003. Their "
        "rows and ours beside them, and the table of settings, are of before windows were mirrored.",
    )
