"""What ECHO's paper prints in its Tables 1, 2 and 4, beside which ours stand."""

from wearcap.metrics.table import Scores, Summary

WHOLE = ("mpjpe_mm", "mpjve_printed", "foot_contact", "v2v_cm", "center_cm", "rotation_deg", "quaternion")
"""The paper's columns of Table 1."""
PAPER: Scores = {
    name: {key: Summary(value, None, 4) for key, value in zip(keys, values)}
    for name, keys, values in (
        ("paper: BEHAVE", WHOLE, (61.4, 66.8, 0.91, 29.5, 17.1, 82.1, 1.4)),
        ("paper: OMOMO", WHOLE, (64.1, 69.7, 0.95, 26.7, 15.6, 86.8, 1.2)),
        ("paper: human alone, BoDiffusion, BEHAVE", WHOLE[:3], (61.4, 73.3, 0.94)),
        ("paper: human alone, BoDiffusion, OMOMO", WHOLE[:3], (61.2, 68.5, 0.98)),
        ("paper: BoDiffusion+Obj, BEHAVE", WHOLE[:5], (84.1, 95.9, 0.96, 36.1, 24.5)),
        ("paper: all contacts given, BEHAVE", (*WHOLE[:2], *WHOLE[3:5]), (59.0, 65.1, 27.0, 14.2)),
        ("paper: no contacts, BEHAVE", ("mpjpe_mm", "v2v_cm"), (72.1, 33.0)),
        ("paper: no AMASS, BEHAVE", ("mpjpe_mm", "v2v_cm"), (83.4, 34.9)),
        ("paper: no canonical frame, BEHAVE", ("mpjpe_mm", "v2v_cm"), (125.0, 39.5)),
    )
}  # fmt: skip
PAPER_HUMAN: Scores = {
    f"paper: {name}, AMASS": {key: Summary(value, None, 4) for key, value in row.items()}
    for name, row in {
        "ours": {"mpjpe_mm": 93.9, "mpjve_printed": 109.7, "foot_contact": 1.0},
        "EgoAllo": {"mpjpe_mm": 116.5, "foot_contact": 1.0},
        "BoDiffusion": {"mpjpe_mm": 67.0, "mpjve_printed": 78.7, "foot_contact": 1.0},
        "BoDiffusion+Obj": {"mpjpe_mm": 91.5, "mpjve_printed": 115.5, "foot_contact": 1.0},
    }.items()
}
"""Table 2."""
