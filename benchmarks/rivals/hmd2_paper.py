"""Figures of the thesis's tables of HMD², on Nymeria."""

from collections.abc import Iterable, Mapping

from wearcap.metrics.table import Scores, Summary

PAPER_TAIL = {
    "EgoEgo": (30.91, 60.81, 58.63, 19.26, 10.33),
    "AvatarPoser (head)": (22.09, 43.19, 44.18, 13.01, 18.96),
    "AvatarPoser (head and hands)": (16.48, 11.23, 37.91, 5.63, 18.15),
    "HMD² (h = 180)": (15.49, 34.86, 27.35, 10.80, 4.22),
}
"""Thesis Table 6.6, on Nymeria."""
PAPER = {
    "EgoEgo": (16.61, 34.64, 35.69, 20.15, 3.68, 2.43),
    "AvatarPoser (head)": (10.64, 21.51, 27.61, 12.99, 1.69, 4.21),
    "HMD² (h = 180)": (8.36, 16.64, 2.16, 15.74, 1.03, 1.03),
    "HMD² (h = 10)": (9.19, 17.67, 5.00, 15.23, 1.30, 1.19),
}
"""Thesis Table 6.1, on Nymeria: MPJPE, hand, FID, Diversity (truth 16.13), Physicality (truth 0.56), floor penetration."""
PAPER_METRICS = ("mpjpe_cm", "hand_pe_cm", "fid", "diversity", "physicality", "floor_penetration_cm")


def paper_rows(columns: Iterable[str], paper: Mapping[str, tuple[float, ...]]) -> Scores:
    """Rows of the paper."""
    return {
        f"the paper's {name}, on Nymeria": {metric: Summary(value, None, 1) for metric, value in zip(columns, values)}
        for name, values in paper.items()
    }
