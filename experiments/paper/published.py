"""The paper's own figures, from its Tables 2 and 3, of other imagery: compare the order."""

from experiments.paper.methods import CANNY, GREY, SAM, SEGMENTS, column

TRAJECTORIES = ("A", "B", "C", "D")
TABLE_2 = {
    ("bovw", GREY): (50.40, 23.92, 2.67, 1.20),
    ("triplet", GREY): (16.02, 82.16, 78.60, 54.21),
    ("triplet", CANNY): (43.91, 67.94, 85.28, 44.58),
    ("triplet", SAM): (12.42, 30.06, 78.26, 67.47),
    ("autoencoder", GREY): (86.24, 71.20, 92.00, 50.00),
    ("autoencoder", CANNY): (88.16, 90.20, 99.67, 88.10),
    ("autoencoder", SAM): (89.76, 90.40, 98.00, 83.33),
}
"""Table 2: accuracy at 15 m in per cent for A, B, C and D."""
TABLE_3 = {
    GREY: ((0, 0), (89.5, 72.8), (99.2, 91.3), (82.0, 46.4)),
    CANNY: ((96.0, 12.1), (99.7, 91.0), (98.6, 85.7), (100, 79.7)),
    SAM: ((95.0, 0.2), (96.4, 89.8), (99.3, 98.6), (100, 67.8)),
}
"""Table 3: accuracy and accepted share in per cent at Lowe's ratio 1.13, auto-encoder."""
LOWE = 1.13
VIEWS = {"A": 625, "B": 500, "C": 300, "D": 84}
"""Numbers of views that most shares of Table 2 are multiples of; the triplet's have one less."""
MOST_VIEWS = 500
"""Most views along the route of a scene that is not in the paper."""


def most_views(scene: str) -> int:
    """Most views along the route of a scene."""
    return VIEWS.get(column(scene), MOST_VIEWS)


def stands_for(edges: str) -> str:
    """What the paper looked at where we look at `edges`: segments stand for Segment Anything."""
    return SAM if edges in (SEGMENTS, f"{SAM}-tile") else edges


def published_accuracy(family: str, edges: str, scene: str) -> str:
    """The paper's figure of Table 2 as text, "-" where it has none."""
    row = TABLE_2.get((family, stands_for(edges)))
    if row is None or scene not in TRAJECTORIES:
        return "-"
    return f"{row[TRAJECTORIES.index(scene)]:.1f}"


def published_criterion(family: str, edges: str, scene: str) -> str:
    """The paper's pair of Table 3 as text, "-" where it has none."""
    row = TABLE_3.get(stands_for(edges))
    if row is None or family != "autoencoder" or scene not in TRAJECTORIES:
        return "-"
    right, accepted = row[TRAJECTORIES.index(scene)]
    return f"{right:g}/{accepted:g}"
