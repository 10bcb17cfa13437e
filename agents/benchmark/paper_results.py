"""Table II of the MAexp paper (Zhu et al., ICRA 2024), its numbers as printed; bold marks are not copied, see `best`.

Mean and standard deviation over 300 episodes (3 seeds x 100), on the maps trained on. None: printed as "-", no team
got there. ER and MO in %, CS in local steps.
"""

COLUMNS = (
    "exploration_ratio",
    "coverage_step_85",
    "coverage_step_95",
    "mutual_overlap_85",
    "mutual_overlap_95",
    "reward_variance",
)

PAPER: dict[str, dict[str, tuple]] = {
    "random_obstacles": {
        "itrpo": ((68.81, 5.71), None, None, None, None, (610.73, 79.25)),
        "ippo": ((63.07, 4.69), None, None, None, None, (711.56, 109.97)),
        "matrpo": ((61.12, 3.76), None, None, None, None, (825.65, 63.06)),
        "mappo": ((62.53, 3.38), None, None, None, None, (831.93, 94.97)),
        "vdppo": ((60.04, 4.54), None, None, None, None, (632.18, 83.41)),
        "vda2c": ((64.23, 3.43), None, None, None, None, (810.62, 76.26)),
    },
    "maze": {
        "itrpo": ((79.71, 7.32), (449, 63), (501, 77), (51.56, 6.49), (43.89, 4.76), (931.00, 104.18)),
        "ippo": ((93.17, 4.27), (377, 51), (441, 57), (45.52, 7.87), (42.38, 7.12), (970.43, 76.31)),
        "matrpo": ((86.29, 7.63), (376, 72), (472, 65), (48.21, 9.19), (43.91, 8.12), (910.37, 82.33)),
        "mappo": ((89.15, 5.07), (370, 67), (442, 44), (46.22, 9.46), (38.53, 2.95), (929.25, 89.14)),
        "vdppo": ((83.12, 5.08), (468, 45), (506, 35), (58.96, 5.03), (58.66, 4.02), (951.11, 82.10)),
        "vda2c": ((93.23, 3.54), (322, 59), (416, 54), (49.60, 5.65), (47.62, 5.91), (907.74, 60.99)),
    },
    "indoor_small": {
        "itrpo": ((90.46, 5.12), (268, 45), (437, 65), (51.37, 4.84), (48.90, 2.54), (871.78, 38.41)),
        "ippo": ((94.18, 0.76), (157, 5), (205, 41), (54.06, 3.55), (50.89, 4.59), (576.31, 8.84)),
        "matrpo": ((89.66, 0.79), (237, 13), (356, 92), (57.49, 4.59), (59.37, 4.29), (547.39, 45.81)),
        "mappo": ((93.23, 3.56), (206, 88), (284, 107), (60.78, 9.24), (59.14, 8.47), (602.14, 78.95)),
        "vdppo": ((91.85, 3.01), (236, 92), (358, 111), (64.03, 15.29), (66.83, 17.67), (541.55, 99.39)),
        "vda2c": ((93.59, 0.33), (170, 12), (235, 52), (77.14, 3.89), (77.32, 8.40), (496.54, 33.77)),
    },
    "indoor_medium": {
        "itrpo": ((79.38, 5.00), (400, 84), (557, 47), (49.60, 7.49), (44.77, 6.84), (347.76, 42.10)),
        "ippo": ((91.48, 4.36), (287, 54), (470, 61), (46.38, 3.35), (46.39, 4.36), (318.29, 50.87)),
        "matrpo": ((75.73, 8.91), (472, 44), (536, 67), (49.92, 8.45), (57.92, 8.39), (389.70, 89.74)),
        "mappo": ((87.01, 5.71), (356, 40), None, (38.22, 2.81), None, (385.22, 49.97)),
        "vdppo": ((89.97, 3.11), (308, 41), (447, 24), (36.58, 1.63), (42.38, 0.74), (309.89, 31.52)),
        "vda2c": ((76.93, 3.95), (320, 30), (449, 26), (45.20, 3.32), (40.45, 1.04), (445.24, 39.86)),
    },
    "indoor_large": {
        "itrpo": ((59.40, 3.95), None, None, None, None, (252.95, 104.43)),
        "ippo": ((71.32, 4.79), None, None, None, None, (257.30, 59.91)),
        "matrpo": ((77.31, 4.39), None, None, None, None, (280.52, 74.28)),
        "mappo": ((70.19, 4.94), None, None, None, None, (248.80, 87.86)),
        "vdppo": ((67.72, 4.96), None, None, None, None, (198.38, 78.41)),
        "vda2c": ((73.97, 2.86), None, None, None, None, (275.55, 37.27)),
    },
    "outdoor": {
        "itrpo": ((26.91, 4.12), None, None, None, None, (457.93, 84.23)),
        "ippo": ((33.06, 6.90), None, None, None, None, (534.92, 94.25)),
        "matrpo": ((32.72, 4.31), None, None, None, None, (433.80, 115.81)),
        "mappo": ((38.15, 7.24), None, None, None, None, (445.98, 118.32)),
        "vdppo": ((30.31, 5.48), None, None, None, None, (431.67, 103.54)),
        "vda2c": ((26.76, 4.38), None, None, None, None, (561.50, 114.43)),
    },
}


def paper_value(scenario: str, policy: str, metric: str) -> tuple[float, float] | None:
    """(mean, standard deviation) that the paper printed, None where it has none."""
    row = PAPER.get(scenario, {}).get(policy)
    return None if row is None or metric not in COLUMNS else row[COLUMNS.index(metric)]
